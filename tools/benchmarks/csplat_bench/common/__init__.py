"""What several benchmarks share: scenes, clocks, peers, command lines, rows that are kept, tables."""
