"""What the codec makes of scenes: throughput, memory, size and quality, and whether both decoders agree."""
