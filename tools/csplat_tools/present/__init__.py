"""Renders, films, the viewer and its page."""
