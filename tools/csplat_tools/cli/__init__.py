"""One module per command: it parses, calls a library function, prints."""
