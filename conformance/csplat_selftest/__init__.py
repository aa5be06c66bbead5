"""Tests of the conformance suite: decoders with planted faults, mutants, fuzzing. In a checkout only, not in the wheel.

`decoder_faults` has mistakes that people make, `mutation` changes operator by operator, `fuzzing` damages files.
"""
