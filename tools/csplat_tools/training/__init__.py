"""Train scenes from photographs, and tune files to look like photographs or the source."""
