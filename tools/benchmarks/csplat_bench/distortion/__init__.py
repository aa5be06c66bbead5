"""Bytes at equal quality: beside other formats, with and without grades, and for those who download."""
