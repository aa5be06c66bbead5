# SPDX-License-Identifier: CC0-1.0
"""Fuzzing of the decoders and of readers of other formats.

`conformance/lab/fuzz.py` is the program. A target damages files of a corpus and reports the result of each attempt.
Files that reach new edges of the program (`edges`) join the corpus.
"""
