"""Edit scenes and files: merge, transform, change the up direction."""
