"""Encoders as others may write them: csplat's own with one planted fault at a time, and the table of what finds it.

Usage:
    python tests/encoder_faults --table                      # every fault, and which level and clause find it
    python tests/encoder_faults --table --groups statements  # those of some modules
    python tests/encoder_faults FAULT in.ply out.csplat      # one of them, as the conformance suite starts it

A fault is planted where a third party would make it: in reading the PLY (`ply_reader`), in what is made of the scene
before it is coded (`preparation`), where values become integers (`quantisation`), in blocks, streams and chunks
(`coding`), in the bytes of the file (`file_bytes`), in what the file states (`statements`), or in how the program ends
and what it leaves behind (`behaviour`). Some are none: freedoms that encoders have, which the suite must not report.
"""
