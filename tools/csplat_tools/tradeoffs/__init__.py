"""Measure size, quality and time of a scene over many encoder settings, as `csplat tradeoff` does."""
