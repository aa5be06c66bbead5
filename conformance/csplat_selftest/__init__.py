"""Tests of the conformance suite: mutants of our decoders, and fuzzing. In a checkout only, not in the wheel."""
