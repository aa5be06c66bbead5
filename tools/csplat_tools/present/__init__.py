"""What people look at: pictures, films, the viewer and its page."""
