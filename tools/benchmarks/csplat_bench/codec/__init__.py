"""Benchmarks of the codec: throughput, memory, size, quality; how fast decoders are, and whether ours agree."""
