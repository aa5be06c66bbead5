"""What a compression is to be held against: the same steps without quantisers, base colours in the codebook, shares."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from compression_runs import Bench
from compression_sizes import Book, coded_colour_bytes
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import Draft, EncodeOptions, Frozen, Held, Importance, Seen, cluster
from csplat.model import SplatModel
from csplat_trainer.finetune import finetune
from csplat_trainer.sensitivity import Sensitivity

__all__ = ["PUBLISHED", "Unquantised", "cluster_colours", "control", "eight_bits", "histogram", "sh0_rows"]

F32 = NDArray[np.float32]

#: Sensitivities of colour and shape above which the publication (CVPR 2024) keeps vectors out of clustering.
PUBLISHED = {"colour": 6e-7, "shape_net": 3e-6}

_DECADES = range(-10, 0)
_CLIP = 511  # lattice steps, as the encoder clips what it clusters
_MANY = 4096  # entries from which on near groups are searched alone, as the encoder does


class Unquantised(Frozen):
    """A frozen scene whose quantisers do nothing: tuning it is training on, with the same steps and the same views."""

    @classmethod
    def of(cls, frozen: Frozen) -> Unquantised:
        """The same scene; it must have no codebooks."""
        assert not frozen.stage_sizes
        assert frozen.shapes is None
        return cls(**{**vars(frozen), "zero": None})

    def constrain(self, held: Held) -> None:
        """Leave values where they are: no file bounds them."""

    def seen(self, held: Held) -> Seen:
        """The values themselves, in arrays of their own."""
        here = held.copy()
        return Seen(here.means, here.quats, here.scales, here.opacities, here.sh0, here.sh)


def control(bench: Bench) -> dict[str, Any]:
    """As many steps on values that no quantiser touches, and then a file of them that is not tuned.

    What they gain is what further training gains: the file that was tuned is to be held against that.
    """
    chosen, _ = bench.chosen()
    options = EncodeOptions(preset="fast", sh_coding="scalar", threads=bench.threads)
    frozen = bench.frozen(chosen.model, chosen.rows, options, chosen.importance)
    start = time.perf_counter()
    run = finetune(
        Unquantised.of(frozen), bench.views, replace(bench.tuning, byte_cost=0.0, patience=0), threads=bench.threads
    )
    seconds = time.perf_counter() - start
    held = run.held
    trained = replace(
        frozen.draft.model, means=held.means, quats=held.quats, scales=held.scales, opacities=held.opacities,
        sh0=held.sh0, shN=held.sh,
    )  # fmt: skip
    rows = np.searchsorted(chosen.rows, frozen.source_index)
    told = chosen.importance
    weights = told.select(rows) if isinstance(told, Importance) else told[rows]
    again = bench.frozen(trained, frozen.source_index, bench.encoding, weights)
    data = again.coded(again.start()).write().data
    scores = bench.judge({"source": bench.source, "trained on": trained, "then a file": decode(data)})
    return {
        "steps": run.log["steps"],
        "best_step": run.log["best_iteration"],
        "seconds": seconds,
        "splats": len(trained),
        "size_bytes": len(data),
        "scores": scores,
    }


def sh0_rows(bench: Bench, size: int, escape: float) -> list[dict[str, Any]]:
    """Colours by codebook on the model, all else untouched: without the base colour in it, and with it.

    Args:
        bench: the scene.
        size: entries.
        escape: share of the splats that keep colours of their own.
    """
    chosen, _ = bench.chosen()
    step = Draft.of(chosen.model, bench.encoding, graded=False).frozen().plan.sh_step
    weights = np.asarray(bench.sensitivity.colour_squares[chosen.rows], np.float32)
    coefficients = 3 * chosen.model.shN.shape[1]
    models, books = {"all": chosen.model}, {}
    for name, base in (("SH 1 to 3", False), ("SH 0 to 3", True)):
        models[name], books[name] = cluster_colours(
            chosen.model, weights, size, step, escape, base=base, seed=bench.encoding.seed, threads=bench.threads
        )
    scores = bench.judge(models)
    return [
        {
            "row": name,
            "entries": book.entries,
            "escapes": book.escaped / len(chosen.model),
            "colour_bytes": coded_colour_bytes(len(chosen.model), coefficients, book, base=name == "SH 0 to 3"),
            "before": scores["all"],
            **scores[name],
        }
        for name, book in books.items()
    ]


def cluster_colours(
    model: SplatModel, weights: F32, size: int, step: float, escape: float, *, base: bool, seed: int,
    threads: int | None,
) -> tuple[SplatModel, Book]:  # fmt: skip
    """Replace colours by entries of a codebook.

    Args:
        model: the scene, with SH bands above 0.
        weights: [N], of squared errors.
        size: entries.
        step: of the lattice on which is clustered.
        escape: share of the splats, those with the largest weighted error, that keep their own.
        base: whether the base colour is clustered with the rest.
        seed: of the k-means.
        threads: how many; `None` for all.
    """
    first = [model.sh0[:, None]] if base else []
    wanted = np.concatenate([*first, model.shN], axis=1).reshape(len(model), -1)
    points = np.rint(np.clip(wanted / np.float32(step), -_CLIP, _CLIP)).astype(np.int16)
    near = 8 if size >= _MANY else 0
    entries, index = cluster(points, weights, size, seed=seed, near_groups=near, threads=threads)
    served = entries[index].astype(np.float32) * np.float32(step)
    errors = weights * np.square(served - wanted).sum(axis=1)
    own = np.argsort(-errors, kind="stable")[: int(len(model) * escape)]
    served[own] = wanted[own]
    colours = served.reshape(len(model), -1, 3)
    book = Book(len(entries), len(own))
    if base:
        return replace(model, sh0=colours[:, 0].copy(), shN=colours[:, 1:].copy()), book
    return replace(model, shN=colours), book


def eight_bits(model: SplatModel, encoding: EncodeOptions) -> EncodeOptions:
    """Eight bits for every value between the least and the largest of its attribute, 16 for positions.

    Args:
        model: the scene.
        encoding: all other options.
    """

    def step(values: NDArray[Any]) -> float:
        return max(float(np.ptp(values)) / 255.0, 1e-6) if values.size else 1.0

    return replace(
        encoding, position_bits=16, scale_step=step(model.scales), opacity_levels=255, quat_levels=127,
        sh0_step=step(model.sh0), sh_step=step(model.shN), chroma_shift=0,
    )  # fmt: skip


def histogram(found: Sensitivity) -> dict[str, Any]:
    """Shares of the splats by decade of their sensitivities, and above the published thresholds."""
    shares = {}
    for name in ("colour", "opacity", "shape", "shape_net"):
        values = getattr(found, name)
        none = int(np.count_nonzero(values == 0.0))
        counts = np.histogram(values, [0.0, *(10.0**at for at in _DECADES), np.inf])[0]
        counts[0] -= none
        shares[name] = [float(count / len(values)) for count in (none, *counts)]
    above = {name: float(np.mean(getattr(found, name) > least)) for name, least in PUBLISHED.items()}
    return {"decades": list(_DECADES), "shares": shares, "above": above, "unseen": found.unseen_share}
