# SPDX-License-Identifier: CC0-1.0
"""Faults in exit status, output files, treatment of the user's files, and the source index."""

import os
import sys
import time
from functools import cache

import numpy as np

from csplat_conformance.encoders import all_inputs
from encoder_faults.fault import PLAIN, EncoderFault, Harm

NO_FILE, FILES = Harm.VALIDITY, Harm.FILES
MAP = (Harm.FACTS, ("L2", "SRC-4"))


# Ends -----------------------------------------------------------------------------------------------
def half_and_proud(_ply, out, data):
    out.write_bytes(data[: len(data) // 2])


def leaves_half(_ply, out, data):
    out.write_bytes(data[: len(data) // 2])
    sys.stderr.write("error: the disk is full\n")
    sys.exit(1)


def hangs(*_):
    time.sleep(600)


# Files of the user ----------------------------------------------------------------------------------
def appended(ply, out, data):
    with ply.open("ab") as stream:
        stream.write(b"\n")
    out.write_bytes(data)


def touched(ply, out, data):
    """Write the same bytes again, which only changes the modification time."""
    ply.write_bytes(ply.read_bytes())
    out.write_bytes(data)


def moved_away(ply, out, data):
    out.write_bytes(data)
    ply.unlink()


def temporary_left(_ply, out, data):
    out.with_suffix(".csplat.part").write_bytes(data)
    out.write_bytes(data)


# Refusals -------------------------------------------------------------------------------------------
@cache
def nasty():
    return frozenset(one.make() for one in all_inputs() if one.name.startswith("nasty/"))


def refuses_the_unusual(ply, out, data):
    if ply.read_bytes() in nasty():
        sys.exit("error: this scene is unusual")
    out.write_bytes(data)


def refuses_without_splats(ply, out, data):
    """Print the reason to standard output instead of standard error."""
    if b"element vertex 0\n" in ply.read_bytes():
        print("error: there are no splats in it")
        sys.exit(1)
    out.write_bytes(data)


def talks(_ply, out, data):
    sys.stderr.write("warning: this scene has no licence\n")
    print("done")
    out.write_bytes(data)


FAULTS = {
    # ends
    "half_a_file": EncoderFault("write errors are always reported", NO_FILE, ("L1", "HDR-5"), end=half_and_proud),
    "leaves_half": EncoderFault("a failed run may leave a file", NO_FILE, ("L1", ""), end=leaves_half),
    "writes_nothing": EncoderFault("the output path can be ignored", NO_FILE, ("L1", ""), end=lambda *_: None),
    "crashes": EncoderFault("memory never runs out", NO_FILE, ("L1", ""), end=lambda *_: os.abort(), starts=True),
    "hangs": EncoderFault("every loop ends", NO_FILE, ("L1", ""), end=hangs, starts=True),
    "status_3": EncoderFault("any exit status will do", NO_FILE, ("L1", ""), end=lambda *_: sys.exit(3)),
    "silent_refusal": EncoderFault("status 1 needs no message", NO_FILE, ("L1", ""), end=lambda *_: sys.exit(1)),
    "refuses_the_unusual": EncoderFault(
        "unusual scenes may be refused", Harm.COARSE, ("L1", ""), "nasty/*", end=refuses_the_unusual
    ),
    "refuses_on_stdout": EncoderFault(
        "a refusal may go to either stream", Harm.HARMLESS, inputs="nasty/empty", end=refuses_without_splats
    ),
    "talks": EncoderFault("a program may print messages", Harm.HARMLESS, end=talks),
    # files of the user
    "input_appended": EncoderFault("an input without a final line feed needs one", FILES, ("L1", ""), end=appended),
    "input_moved_away": EncoderFault("the PLY is no longer needed", FILES, ("L1", ""), end=moved_away),
    "input_touched": EncoderFault("writing the same bytes does not matter", Harm.HARMLESS, end=touched),
    "temporary_left": EncoderFault("the system removes temporary files", FILES, ("L1", ""), end=temporary_left),
    # source index
    "index_inverse": EncoderFault("the index maps source to file", *MAP, PLAIN, index=np.argsort),
    "index_from_one": EncoderFault("splats are numbered from 1", *MAP, PLAIN, index=lambda index: index + 1),
    "index_in_floats": EncoderFault("any type will do", *MAP, PLAIN, index=lambda index: index.astype(np.float64)),
}
