"""The encoder's own word on which splat of the source each splat of its file is (spec SRC-4)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from csplat.errors import InputError
from csplat.files import read_array
from csplat_conformance.encoders.matching import Pairs
from csplat_conformance.encoders.verdict import Wrong
from csplat_conformance.stated import Source, check_source_index

CLAUSE = "SRC-4"


def check_index(path: Path, source: Source, count: int, pairs: Pairs) -> tuple[Pairs, list[Wrong]]:
    """Compare a source index with what lies near.

    Args:
        path: the .npy file.
        source: the encoded scene.
        count: splats of the file.
        pairs: the source splat near each of them.

    Returns:
        The pairs with the encoder's own index if it is right, as they are if not; and what is wrong.
    """
    if not path.exists():
        return pairs, [(CLAUSE, "no source index was written")]
    try:
        found = read_array(path)
        check_source_index(found, len(source), count)
    except (InputError, OSError) as error:
        return pairs, [(CLAUSE, str(error).replace(str(path), "the source index"))]
    index = found.astype(np.int64)
    paired = np.flatnonzero(pairs.source_index >= 0)
    near = pairs.source_index[paired]
    # Only the encoder can tell splats with equal centres apart.
    off = paired[(source.means[index[paired]] != source.means[near]).any(axis=1)]
    if len(off):
        text = (
            f"splat {off[0]} is called splat {index[off[0]]} of the source, nearest is {pairs.source_index[off[0]]}"
            f" ({len(off)} of {count} numbers of the index are wrong)"
        )
        return pairs, [(CLAUSE, text)]
    return replace(pairs, source_index=index) if len(paired) == count else pairs, []
