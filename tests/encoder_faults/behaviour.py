"""Faults in how the program ends, what it leaves, what it does to the user's files, and its map of splats."""

import os
import sys
import time
from functools import cache

import numpy as np
import plyfile

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


def resaved(ply, out, data):
    """Read and write with a library, in the same place, without the normals."""
    content = plyfile.PlyData.read(ply, mmap=False)
    columns = content["vertex"].data
    names = [name for name in columns.dtype.names if name not in ("nx", "ny", "nz")]
    kept = np.empty(len(columns), [(name, columns.dtype[name]) for name in names])
    for name in names:
        kept[name] = columns[name]
    plyfile.PlyData([plyfile.PlyElement.describe(kept, "vertex")], byte_order="<").write(ply)
    out.write_bytes(data)


def appended(ply, out, data):
    with ply.open("ab") as stream:
        stream.write(b"\n")
    out.write_bytes(data)


def touched(ply, out, data):
    """Write the same bytes again: nothing is lost, though a program that builds by date thinks so."""
    ply.write_bytes(ply.read_bytes())
    out.write_bytes(data)


def moved_away(ply, out, data):
    out.write_bytes(data)
    ply.unlink()


def temporary_left(_ply, out, data):
    out.with_suffix(".csplat.part").write_bytes(data)
    out.write_bytes(data)


def log_left(ply, out, data):
    ply.with_suffix(".ply.log").write_text(f"{len(data)} bytes\n")
    out.write_bytes(data)


def written_twice(_ply, out, data):
    (out.parent / "scene.csplat").write_bytes(data)
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
    """Say why on standard output alone, which is as good a place."""
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
    "half_a_file": EncoderFault("a full disk says so", NO_FILE, ("L1", "HDR-5"), end=half_and_proud),
    "leaves_half": EncoderFault("whoever fails may leave a file", NO_FILE, ("L1", ""), end=leaves_half),
    "writes_nothing": EncoderFault("the output's name is not needed", NO_FILE, ("L1", ""), end=lambda *_: None),
    "crashes": EncoderFault("memory is never short", NO_FILE, ("L1", ""), end=lambda *_: os.abort(), starts=True),
    "hangs": EncoderFault("a loop always ends", NO_FILE, ("L1", ""), end=hangs, starts=True),
    "status_3": EncoderFault("3 is a status like any other", NO_FILE, ("L1", ""), end=lambda *_: sys.exit(3)),
    "silent_refusal": EncoderFault("status 1 says enough", NO_FILE, ("L1", ""), end=lambda *_: sys.exit(1)),
    "refuses_the_unusual": EncoderFault(
        "whatever is unusual may be refused", Harm.COARSE, ("L1", ""), "nasty/*", end=refuses_the_unusual
    ),
    "refuses_on_stdout": EncoderFault(
        "a refusal may be said on either stream", Harm.HARMLESS, inputs="nasty/empty", end=refuses_without_splats
    ),
    "talks": EncoderFault("a program may say what it likes", Harm.HARMLESS, end=talks),
    # files of the user
    "input_resaved": EncoderFault("normals are of no use to anyone", FILES, ("L1", ""), end=resaved),
    "input_appended": EncoderFault("a text ends in a line feed", FILES, ("L1", ""), end=appended),
    "input_moved_away": EncoderFault("whoever has the file needs no PLY", FILES, ("L1", ""), end=moved_away),
    "input_touched": EncoderFault("the same bytes are the same file", Harm.HARMLESS, end=touched),
    "temporary_left": EncoderFault("the system clears up", FILES, ("L1", ""), end=temporary_left),
    "log_left": EncoderFault("a log beside the input helps", FILES, ("L1", ""), end=log_left),
    "written_twice": EncoderFault("the scene has a name of its own", FILES, ("L1", ""), end=written_twice),
    # the map of splats
    "index_of_the_file": EncoderFault(
        "splats come in the order of the file", *MAP, PLAIN, index=lambda index: np.arange(len(index))
    ),
    "index_inverse": EncoderFault("the map leads from source to file", *MAP, PLAIN, index=np.argsort),
    "index_from_one": EncoderFault("splats are numbered from 1", *MAP, PLAIN, index=lambda index: index + 1),
    "index_in_floats": EncoderFault("numbers are numbers", *MAP, PLAIN, index=lambda index: index.astype(np.float64)),
    "index_too_short": EncoderFault(
        "the last one follows from the others", *MAP, PLAIN, index=lambda index: index[:-1]
    ),
}
