"""Controls for the compression: the same steps without quantisers, and eight bits for every value."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import DecodedValues, EncodeOptions, FixedQuantisation, FreeValues, Importance
from csplat.model import SplatModel
from csplat_bench.common.measuring import timed
from csplat_bench.compression.rows import Control
from csplat_bench.compression.runs import Bench
from csplat_trainer.tuning import tune


class Unquantised(FixedQuantisation):
    """A fixed quantisation that rounds nothing: tuning it is training on, with the same steps and the same views."""

    @classmethod
    def freeing(cls, fixed: FixedQuantisation) -> Unquantised:
        """The same scene; it must have no codebooks."""
        assert fixed.book is None
        assert fixed.shapes is None
        return cls(**{**vars(fixed), "zero": None})

    def constrain(self, values: FreeValues) -> None:
        """Leave values where they are: no file bounds them."""

    def dequantise(self, values: FreeValues) -> DecodedValues:
        """The values themselves, in arrays of their own."""
        here = values.copy()
        return DecodedValues(here.means, here.quats, here.scales, here.opacities, here.sh0, here.sh)


def control(bench: Bench) -> Control:
    """As many steps on values that no quantiser touches, and then a file of them that is not tuned.

    What they gain is what further training gains: the file that was tuned is to be held against that.
    """
    chosen, _ = bench.chosen()
    options = EncodeOptions(preset="fast", sh_coding="scalar", threads=bench.threads)
    fixed = bench.fix_scene(chosen.model, chosen.rows, options, chosen.importance)
    tuning = replace(bench.tuning, byte_cost=0.0, patience=0)
    run, timing = timed(tune, Unquantised.freeing(fixed), bench.views, tuning, threads=bench.threads)
    values = run.best_values
    trained = replace(
        fixed.encode_plan.model, means=values.means, quats=values.quats, scales=values.scales,
        opacities=values.opacities, sh0=values.sh0, shN=values.sh,
    )  # fmt: skip
    rows = np.searchsorted(chosen.rows, fixed.source_index)
    told = chosen.importance
    weights = told.select(rows) if isinstance(told, Importance) else told[rows]
    again = bench.fix_scene(trained, fixed.source_index, bench.encoding, weights)
    data = again.encode(again.start()).write().data
    scores = bench.judge({"source": bench.source, "trained on": trained, "then a file": decode(data)})
    return {
        "steps": run.log["steps"],
        "best_step": run.log["best_iteration"],
        "seconds": timing.wall,
        "splats": len(trained),
        "size_bytes": len(data),
        "scores": scores,
    }


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
