"""The ablation of the publication on a scene of ours: what each step of a compression takes and leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeResult, FixedQuantisation, FreeValues
from csplat.model import SplatModel
from csplat_bench.common.making import ARRAYS
from csplat_bench.compression.rows import Step
from csplat_bench.compression.runs import Bench, Tuned
from csplat_bench.compression.sizes import books_of, float_bytes, integer_bytes, integer_columns, ply_bytes


def ablation(bench: Bench, tuned: Tuned) -> list[Step]:
    """The steps of the pipeline, one after the other, and what each of them leaves.

    Args:
        bench: the scene.
        tuned: the result with all of them.

    Returns:
        A row for each; its size is as `sizes` counts it.
    """
    fixed, start, log = tuned.fixed, tuned.fixed.start(), tuned.seconds
    before = fixed.dequantise(start)
    pruned, size = fixed.encode_plan.model, len(tuned.chosen.model)
    colours, shapes = books_of(fixed)
    coefficients = 3 * bench.source.shN.shape[1]
    by_colour = _served_colours(fixed, before.shN)
    by_both = _served_shapes(fixed, by_colour, before.quats, before.scales)
    unordered = _unordered(fixed, tuned.best_values)
    files = {"unordered": decode(unordered.data), "file": decode(tuned.result.data)}
    assert _same_set(files["unordered"], files["file"]), "the order of the splats changed what they are"
    models = {
        "none": bench.source, "pruned": pruned, "colours": by_colour, "shapes": by_both,
        "quantised": _as_model(fixed, start), "tuned": _as_model(fixed, tuned.best_values), **files,
    }  # fmt: skip
    scores = bench.judge(models)
    shape_seconds = log["of it shapes"]
    rows: list[tuple[str, str, str, int, float]] = [
        ("none", "none", "PLY", ply_bytes(len(bench.source)), 0.0),
        ("prune unseen", "pruned", "PLY", ply_bytes(size), log["choosing"]),
        ("+ colour codebook" + ("" if colours else " (none made)"), "colours", "floats",
         float_bytes(size, coefficients, colours, None), log["clustering"] - shape_seconds),
        ("+ shape codebook" + ("" if shapes else " (none made)"), "shapes", "floats",
         float_bytes(size, coefficients, colours, shapes), shape_seconds),
        ("+ quantisation", "quantised", "integers", integer_bytes(integer_columns(fixed, start)), 0.0),
        ("+ fine-tuning", "tuned", "integers", integer_bytes(integer_columns(fixed, tuned.best_values)), log["tuning"]),
        ("+ entropy coding", "unordered", "file", len(unordered.data), log["encoding"]),
        ("+ Morton order", "file", "file", len(tuned.result.data), 0.0),
    ]  # fmt: skip
    return [
        {"row": row, "stored": stored, "size_bytes": bytes_, "seconds": seconds, **scores[name]}
        for row, name, stored, bytes_, seconds in rows
    ]


def _served_colours(fixed: FixedQuantisation, shN: NDArray[np.float32]) -> SplatModel:
    """The scene before quantisation, SH by codebook if it has one."""
    model = fixed.encode_plan.model
    if fixed.book is None:
        return model
    served = np.zeros_like(model.shN)  # bands that are not kept are gone
    served[:, : shN.shape[1]] = shN
    served[fixed.book.escaped] = model.shN[fixed.book.escaped]
    return replace(model, shN=served)


def _served_shapes(
    fixed: FixedQuantisation, model: SplatModel, quats: NDArray[np.float32], scales: NDArray[np.float32]
) -> SplatModel:
    """The scene before quantisation, shapes by codebook if it has one."""
    if fixed.shapes is None:
        return model
    own = fixed.shapes.escaped[:, None]
    return replace(model, quats=np.where(own, model.quats, quats), scales=np.where(own, model.scales, scales))


def _as_model(fixed: FixedQuantisation, values: FreeValues) -> SplatModel:
    """Return the model that a decoder will reconstruct, without writing a file."""
    seen, model = fixed.dequantise(values), fixed.encode_plan.model
    shN = np.zeros_like(model.shN)
    shN[:, : seen.shN.shape[1]] = seen.shN
    arrays = {name: getattr(seen, name) for name in ARRAYS if name != "shN"}
    return replace(model, **arrays, shN=shN)


def _unordered(fixed: FixedQuantisation, values: FreeValues) -> EncodeResult:
    """The same file with the splats of each tile in the order of the source, their centres coded axis by axis."""
    plan = fixed.encode_plan
    tiles = [replace(tile, rows=tile.rows[np.argsort(fixed.source_index[tile.rows])]) for tile in plan.tiles]
    plan = replace(plan, tiles=tiles, parameters=replace(plan.parameters, morton=False))
    return replace(fixed, encode_plan=plan).encode(values).write()


def _same_set(one: SplatModel, other: SplatModel) -> bool:
    """Return True if two models hold the same splats, in any order."""
    rows = [
        np.unique(np.concatenate([getattr(model, name).reshape(len(model), -1) for name in ARRAYS], axis=1), axis=0)
        for model in (one, other)
    ]
    return np.array_equal(rows[0], rows[1])
