"""Run a wrong encoder: ours, with one mistake."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import csplat
from csplat import ply as ply_files
from csplat.encoder import Origin, encode_with_report
from wrong_encoders.serr import bounded
from wrong_encoders.truth import true_errors


def encode(mistake, ply, out, index=None):
    """Read, encode, write.

    Args:
        mistake: the mistake.
        ply, out: input and output.
        index: path for the map from splats of the file to those of the source, if requested.
    """
    with np.errstate(all="ignore"):  # a wrong encoder may divide by zero
        data, source_index = _encoded(mistake, ply)
    if mistake.honest is not None:
        data = bounded(true_errors(mistake.honest(ply), csplat.decode(data), source_index))(data)
    if mistake.data is not None:
        data = mistake.data(data)
    if mistake.end is None:
        out.write_bytes(data)
    else:
        mistake.end(ply, out, data)
    if index is not None:
        with Path(index).open("wb") as stream:
            np.save(stream, source_index if mistake.index is None else mistake.index(source_index))


def _encoded(mistake, ply):
    """Return the file, and which splat of the input each of its splats is."""
    if mistake.is_late:
        return honest(ply.read_bytes(), tuple(mistake.options.items()))
    with mistake.stage():
        model = _read(mistake, ply)
        if mistake.scene is not None:
            model = mistake.scene(model)
        origin = None
        if mistake.keep is not None:
            rows = mistake.keep(model).astype(np.int64)
            model, origin = model.select(rows), Origin(len(model), rows)
        result = encode_with_report(model, csplat.EncodeOptions(**mistake.options), origin=origin)
    return result.data, result.source_index


@cache
def honest(content, options=()):
    """Return what our encoder makes of a PLY: the file, and which splat of the input each of its splats is.

    Args:
        content: the PLY.
        options: options of the encoder, (name, value) pairs.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-honest-") as folder:
        path = Path(folder) / "in.ply"
        path.write_bytes(content)
        model = ply_files.read_ply(path, keep_extra=bool(dict(options).get("keep_extra")))
    result = encode_with_report(model, csplat.EncodeOptions(**dict(options)))
    return result.data, result.source_index


def _read(mistake, ply):
    keep_extra = bool(mistake.options.get("keep_extra"))
    if mistake.ply is None:
        return ply_files.read_ply(ply, keep_extra=keep_extra)
    with tempfile.TemporaryDirectory(prefix="csplat-wrong-") as folder:
        path = Path(folder) / "in.ply"
        path.write_bytes(mistake.ply(ply.read_bytes()))
        return ply_files.read_ply(path, keep_extra=keep_extra)
