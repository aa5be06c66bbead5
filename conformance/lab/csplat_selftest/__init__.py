# SPDX-License-Identifier: CC0-1.0
"""Tests of the conformance suite and of our decoders. Only in a checkout, not in the wheel.

`decoder_faults` plants typical mistakes of implementers in our decoders, `mutation` changes single operators of the
decoders, and `fuzzing` damages files.
"""
