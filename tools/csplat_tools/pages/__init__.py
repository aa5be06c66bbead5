"""What the HTML pages of the commands share: their look, their script, bars, and pictures of the hardest place."""
