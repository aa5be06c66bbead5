"""Renders, videos, the viewer and its page."""
