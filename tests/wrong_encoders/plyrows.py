"""The rows of a PLY, for mistakes that are made before anything is a scene."""

import io
import re

import numpy as np
import plyfile

_HEADER = re.compile(rb"\Aply.*?end_header\r?\n", re.DOTALL)


def parsed(data):
    """The columns of the splats, as they stand in the file."""
    return plyfile.PlyData.read(io.BytesIO(data))["vertex"].data


def rows(change):
    """Return a change of a PLY: `change` is given the columns by name, to be changed in place."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = np.array(ply["vertex"].data)
        with np.errstate(all="ignore"):
            change(columns)
        ply["vertex"].data = columns
        out = io.BytesIO()
        ply.write(out)
        return out.getvalue()

    return run


def kept(which):
    """Return a change that leaves out rows: `which` takes the columns and returns the rows to keep."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = np.array(ply["vertex"].data)
        ply["vertex"].data = columns[which(columns)]
        out = io.BytesIO()
        ply.write(out)
        return out.getvalue()

    return run


def each(prefix, change):
    """Return a change of every column of floats whose name begins so."""

    def run(columns):
        for name in columns.dtype.names:
            if name.startswith(prefix) and columns.dtype[name].kind == "f":
                columns[name] = change(columns[name])

    return rows(run)


def header(change):
    """Return a change of a PLY's header and of what follows it."""

    def run(data):
        found = _HEADER.match(data)
        return data if found is None else b"".join(change(found.group(), data[found.end() :]))

    return run


def without(name):
    """Return a change that leaves out a column."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = ply["vertex"].data
        names = [one for one in columns.dtype.names if one != name]
        kept = np.empty(len(columns), [(one, columns.dtype[one]) for one in names])
        for one in names:
            kept[one] = columns[one]
        out = io.BytesIO()
        plyfile.PlyData([plyfile.PlyElement.describe(kept, "vertex")], byte_order="<").write(out)
        return out.getvalue()

    return run
