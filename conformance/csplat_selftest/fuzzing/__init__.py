"""Fuzzing of the decoders and of readers of other formats: what is fed, what must not happen, which lines were reached.

`tests/fuzz.py` is the program. A target makes damaged files from a corpus and reports the result of each attempt;
`edges` tells which of them reach what none before did: they join the corpus.
"""
