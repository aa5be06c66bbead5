"""Command line, conversion, comparison and reports around the csplat codec."""
