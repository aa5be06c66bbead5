"""Bytes at equal quality: compared with other formats, with and without quantisation classes, and for downloads."""
