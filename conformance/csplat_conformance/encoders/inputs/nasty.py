"""Files of unusual make, which an encoder may refuse but must not get wrong."""

from __future__ import annotations

import numpy as np

from csplat_conformance.encoders.inputs.making import Input, cloud, made
from csplat_conformance.encoders.plyfile import Layout, Splats

_FACES = (
    ("element face 3", "property list uchar int vertex_indices"),
    b"".join(bytes((count,)) + bytes(4 * count) for count in (3, 4, 0)),
)
_CAMERA = (("element camera 1", "property double x", "property uchar kind"), bytes(range(9)))


def nasty() -> list[Input]:
    """Return them, in the order of a run."""
    few = lambda: cloud(64, 1, 41)  # noqa: E731 - one of many recipes, used by several inputs
    lists = [bytes(range(row % 4)) for row in range(64)]
    return [
        made("nasty/face_first", "elements before the splats, one of them of rows of any length", few, _first()),
        made("nasty/camera_last", "an element after the splats", few, Layout(after=_CAMERA)),
        made("nasty/list_property", "a list among a splat's columns: rows of any length", few, Layout(lists=lists)),
        made("nasty/crlf_header", "lines of the header end in CR LF, rows are binary", few, Layout(line_end="\r\n")),
        made(
            "nasty/trailing_bytes",
            "bytes after the last row, two rows long",
            few,
            Layout(after=((), b"\n\0not a row " * 16)),
        ),
        made(
            "nasty/foreign_comments",
            "comments of UTF-8 and of bytes that are none",
            few,
            Layout(comments=("Größe: 3 µm, 雪", "\udcff\udcfe caf\udce9", "element vertex 5", "end_header?")),
        ),
        made(
            "nasty/degree_4",
            "72 columns f_rest: csplat ends at degree 3, and a file says so",
            lambda: cloud(64, 4, 42),
            renders=False,
        ),
        made("nasty/double_means", "x, y, z in doubles beside columns in floats", few, Layout(means_dtype="f8")),
        made("nasty/nan_normals", "NaN and infinities in normals, which splats do not use", _nan_normals),
        made("nasty/nan_extra", "NaN in a column that splats do not have", _nan_extra),
    ]


def _first() -> Layout:
    return Layout(before=((*_FACES[0], *_CAMERA[0]), _FACES[1] + _CAMERA[1]))


def _nan_normals() -> Splats:
    splats = cloud(64, 1, 43)
    splats.normals = np.zeros((64, 3), np.float32)
    splats.normals[5:20], splats.normals[30:33] = np.nan, -np.inf
    return splats


def _nan_extra() -> Splats:
    splats = cloud(64, 1, 44)
    splats.extra = {"confidence": np.where(np.arange(64) % 5, 0.5, np.nan).astype("<f4")}
    return splats
