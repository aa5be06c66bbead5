"""Faulty encoders: csplat's encoder with one planted fault at a time, to test the conformance suite.

Usage:
    python tests/encoder_faults --table                      # every fault, with the level and clause that catch it
    python tests/encoder_faults --table --groups statements  # the faults of some modules
    python tests/encoder_faults FAULT in.ply out.csplat      # encode with one fault, as the conformance suite does

Each fault is a mistake that the author of another encoder could make: in reading the PLY (`ply_reader`), in preparing
the scene (`preparation`), in converting values to integers (`quantisation`), in blocks, streams, chunks and bytes of
the file (`file_bytes`), in the errors and counts that the file states (`statements`), or in the way the program ends
and in the files it leaves behind (`behaviour`). Some are harmless choices, which the suite must not report.
"""
