"""Scenes that are learnt from photographs, and files that are tuned until they look right."""
