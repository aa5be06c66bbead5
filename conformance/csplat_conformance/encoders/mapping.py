"""The encoder's own word on which splat of the source each splat of its file is (spec SRC-4)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat_conformance.encoders.matching import Pairs
from csplat_conformance.encoders.verdict import Wrong
from csplat_conformance.stated import Source

__all__ = ["check_index"]

CLAUSE = "SRC-4"


def check_index(path: Path, source: Source, count: int, pairs: Pairs) -> tuple[Pairs, list[Wrong]]:
    """Compare a source index with what lies near.

    Args:
        path: the .npy file.
        source: what was encoded.
        count: splats of the file.
        pairs: which source splat is near to each of them.

    Returns:
        The pairs with the encoder's own index if it is right, as they are if not; and what is wrong.
    """
    found = _read(path)
    text = found if isinstance(found, str) else _wrong_form(found, count, len(source))
    if text or isinstance(found, str):
        return pairs, [(CLAUSE, text)]
    index = found.astype(np.int64)
    paired = np.flatnonzero(pairs.source_index >= 0)
    near = pairs.source_index[paired]
    # Splats with equal centres are told apart by nobody but the encoder.
    off = paired[(source.means[index[paired]] != source.means[near]).any(axis=1)]
    if len(off):
        text = (
            f"splat {off[0]} is called splat {index[off[0]]} of the source, nearest is {pairs.source_index[off[0]]}"
            f" ({len(off)} of {count} numbers of the index are wrong)"
        )
        return pairs, [(CLAUSE, text)]
    return replace(pairs, source_index=index) if len(paired) == count else pairs, []


def _read(path: Path) -> NDArray[Any] | str:
    """Return the array, or why there is none."""
    try:
        with path.open("rb") as stream:
            result: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    except FileNotFoundError:
        return "no source index was written"
    except (ValueError, OSError, EOFError, MemoryError, SyntaxError) as error:
        return f"the source index is no .npy file: {error}"
    return result


def _wrong_form(index: NDArray[Any], count: int, source_count: int) -> str:
    """Say what is wrong with an index as such; nothing where nothing is."""
    if index.dtype.kind not in "iu" or index.shape != (count,):
        return f"the source index is {index.dtype} of shape {list(index.shape)}, wanted integers of shape [{count}]"
    if not count:
        return ""
    outside = (index < 0) | (index >= source_count)
    if outside.any():
        first = int(outside.argmax())
        return f"splat {first} is called splat {index[first]} of the source, which has {source_count}, from 0 on"
    values, counts = np.unique(index, return_counts=True)
    if len(values) != count:
        twice = values[counts.argmax()]
        first, second = np.flatnonzero(index == twice)[:2]
        return f"splats {first} and {second} are both called splat {twice} of the source"
    return ""
