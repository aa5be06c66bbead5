"""Encoders as others may write them: csplat's own with one mistake at a time, and the table of what finds it.

Usage:
    python tests/wrong_encoders --table                    # every mistake, and which level and clause find it
    python tests/wrong_encoders --table --groups stating   # those of some modules
    python tests/wrong_encoders MISTAKE in.ply out.csplat  # one of them, as the conformance suite starts it

A mistake is made where a third party would make it: in reading the PLY (`reading`), in what is made of the scene
before it is coded (`preparing`), where values become integers (`quantising`), in blocks, streams and chunks (`coding`),
in the bytes of the file (`file_bytes`), in what it states (`stating`), or in how the program ends and what it leaves
behind (`behaving`). Some are none: freedoms that encoders have, of which the suite must say nothing.
"""
