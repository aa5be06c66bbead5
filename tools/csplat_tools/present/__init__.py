"""Output for people to look at: renders, films, the viewer and its page."""
