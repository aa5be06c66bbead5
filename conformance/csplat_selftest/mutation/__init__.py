"""Decoders changed operator by operator: which changes do the vectors miss? `python -m csplat_selftest.mutation`."""
