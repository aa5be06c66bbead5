"""Inputs that an encoder must refuse."""

from __future__ import annotations

from functools import cache

import numpy as np

from csplat_conformance.encoders.inputs.making import Input, cloud
from csplat_conformance.encoders.plyfile import Layout, write


def broken() -> list[Input]:
    """Return them, in the order of a run."""
    whole = cache(lambda: write(cloud(64, 1, 31)))

    def of(layout: Layout) -> bytes:
        return write(cloud(64, 1, 31), layout)

    ten = Layout(renamed={"nx": "f_rest_9"})
    hole = Layout(renamed={"f_rest_4": "f_rest_9"})
    return [
        Input("broken/nothing", "no bytes at all", lambda: b"", None),
        Input("broken/no_ply", "a text that is no PLY", lambda: b"splats, but not here\n" * 9, None),
        Input("broken/header_without_end", "a header that ends nowhere", lambda: whole().partition(b"end_h")[0], None),
        Input("broken/cut", "the last splats are missing", lambda: whole()[:-400], None),
        Input("broken/countless", "10^12 splats are declared, 64 are there", lambda: of(Layout(count=10**12)), None),
        Input("broken/negative_count", "fewer splats than none are declared", lambda: of(Layout(count=-64)), None),
        Input("broken/no_colour", "a PLY of points, not of splats", _points, None),
        Input("broken/no_opacity", "no column opacity", lambda: of(Layout(renamed={"opacity": ""})), None),
        Input("broken/no_rotation", "no column rot_3", lambda: of(Layout(renamed={"rot_3": ""})), None),
        Input("broken/ten_f_rest", "ten columns f_rest are no SH degree", lambda: of(ten), None),
        Input("broken/hole_in_f_rest", "nine columns f_rest without number 4", lambda: of(hole), None),
        Input("broken/no_number", "a word where a number belongs", _word, None),
    ]


def _points() -> bytes:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return head.encode("ascii") + np.arange(27, dtype="<f4").tobytes()


def _word() -> bytes:
    lines = write(cloud(64, 1, 31), Layout(format="ascii")).split(b"\n")
    lines[-9] = b" ".join([*lines[-9].split()[:-1], b"mean"])
    return b"\n".join(lines)
