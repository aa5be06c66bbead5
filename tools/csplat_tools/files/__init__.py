"""Scenes, arrays, pictures and packages as files: found by their paths, written whole or not at all."""
