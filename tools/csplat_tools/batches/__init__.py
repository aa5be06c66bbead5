"""Many scenes, one command: `csplat batch`."""
