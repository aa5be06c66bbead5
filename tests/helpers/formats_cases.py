# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of formats, which several files share."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def same(a, b):
    assert all((getattr(a, name) == getattr(b, name)).all() for name in ARRAYS)
    assert (a.origin, a.metadata.coordinate_system, a.metadata.antialiased, a.metadata.flat, a.metadata) == (
        b.origin, b.metadata.coordinate_system, b.metadata.antialiased, b.metadata.flat, b.metadata,
    )  # fmt: skip


def npy(header, data=b"", version=1):
    size = struct.pack("<H" if version == 1 else "<I", len(header))
    return b"\x93NUMPY" + bytes([version, 0]) + size + header + data


def header_of(descr="'|u1'", shape="(4,)"):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n".encode()


def zip_of(members, way=zipfile.ZIP_STORED):
    out = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(out, "w", way) as file:
        for name, data in members:
            file.writestr(name, data)
    return out.getvalue()


def with_size(data, size):
    """Return a zip of one deflated member whose directory declares another unpacked size."""
    at = data.index(b"PK\1\2") + 24
    return data[:at] + struct.pack("<I", size) + data[at + 4 :]
