"""What the codec makes of scenes: throughput, memory, size, quality; how fast decoders are, and whether ours agree."""
