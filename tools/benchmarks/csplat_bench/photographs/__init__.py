"""From photographs to files of several sizes: one training, and what `csplat train` makes of it."""
