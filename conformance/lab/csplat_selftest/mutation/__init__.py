# SPDX-License-Identifier: CC0-1.0
"""Mutation testing of the vectors with our decoders: `python -m csplat_selftest.mutation`."""
