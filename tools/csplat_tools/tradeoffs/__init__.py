"""What a scene costs and what it keeps, over everything that can be chosen: the work of `csplat tradeoff`."""
