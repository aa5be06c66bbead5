"""Mutation testing of the vectors with our decoders: `python -m csplat_selftest.mutation`."""
