"""Inspect a file: its content, its validity, its declared errors, and its differences from the source."""
