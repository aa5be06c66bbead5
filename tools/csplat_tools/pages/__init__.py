"""Common parts of the HTML reports of commands: style, script, bars, plots, and images of the hardest place."""
