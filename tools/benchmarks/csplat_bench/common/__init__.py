"""Code shared by several benchmarks: scenes, clocks, peers, command lines, stored results, tables."""
