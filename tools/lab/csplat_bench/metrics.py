# SPDX-License-Identifier: Apache-2.0
"""Metrics of a file: functions that return fields of its row, registered by the names that suites use.

Metrics of time run in every turn, in a new process; all others once per file.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from csplat.context import Context
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.encoders import MadeFile, read_file
from csplat_bench.made_scenes import ARRAYS
from csplat_bench.measuring import alone, peak_bytes, reset_peak, timed
from csplat_bench.scenes import Scene
from csplat_bench.suites import Case
from csplat_render.scorer import Scorer


@dataclass(frozen=True)
class Reference:
    """A scene that files are compared with.

    Attributes:
        scene: the scene.
        views: as in `Scene.scorer`.
    """

    scene: Scene
    views: str

    @cached_property
    def source(self) -> SplatModel:
        """The scene, read."""
        return read_ply(self.scene.path)

    @cached_property
    def scorer(self) -> Scorer:
        """A scorer by the suite's views."""
        return self.scene.scorer(self.source, self.views)

    @cached_property
    def virtual_scorer(self) -> Scorer:
        """A scorer by the views that `csplat compare` chooses."""
        return self.scene.scorer(self.source, "virtual")


Metric = Callable[[MadeFile, Reference, Case], Mapping[str, Any]]


def _psnr(made: MadeFile, reference: Reference, _: Case) -> Mapping[str, Any]:
    """PSNR pooled over the views, dB."""
    return {"psnr": reference.scorer.psnr(made.model)}


def _ssim(made: MadeFile, reference: Reference, _: Case) -> Mapping[str, Any]:
    """PSNR and SSIM; SSIM takes as long as rendering."""
    scores = reference.scorer.scores(made.model)
    return {"psnr": scores.psnr, "ssim": scores.ssim}


def _virtual_psnr(made: MadeFile, reference: Reference, _: Case) -> Mapping[str, Any]:
    """PSNR by the views of `csplat compare`; it should be within 1 dB of that by the cameras of the data folder."""
    return {"virtual_psnr": reference.virtual_scorer.psnr(made.model)}


def _encode(_: MadeFile, reference: Reference, case: Case) -> Mapping[str, Any]:
    """Encoding by a preset, from arrays to bytes."""
    wall, cpu, growth, arrays = alone(encode_once, reference.scene.path, case["preset"], case.get("threads"))
    return {
        "encode_seconds": wall, "encode_cpu_seconds": cpu, "encode_growth_bytes": growth, "array_bytes": arrays,
    }  # fmt: skip


def _decode(made: MadeFile, *_: object) -> Mapping[str, Any]:
    """Reading the file once more after a first time, which imports and warms up."""
    wall, cpu, growth = alone(read_twice, made.path)
    return {"decode_seconds": wall, "decode_cpu_seconds": cpu, "decode_growth_bytes": growth}


def encode_once(ply: Path, preset: Any, threads: int | None) -> tuple[float, float, int, int]:
    """Encode a PLY from arrays to bytes; return wall and CPU seconds, growth and size of the arrays in bytes."""
    model, options = read_ply(ply), EncodeOptions(preset=preset)
    gc.collect()
    before = reset_peak()
    _, timing = timed(encode, model, options, context=Context(threads=threads))
    arrays = sum(getattr(model, name).nbytes for name in ARRAYS)
    return timing.wall, timing.cpu, peak_bytes() - before, arrays


def read_twice(path: Path) -> tuple[float, float, int]:
    """Read a file twice; return wall and CPU seconds of the second time, and growth during the first in bytes."""
    before = reset_peak()
    read_file(path)
    growth = peak_bytes() - before
    _, timing = timed(read_file, path)
    return timing.wall, timing.cpu, growth


#: By name: the function, and whether it measures time.
METRICS: dict[str, tuple[Metric, bool]] = {
    "psnr": (_psnr, False),
    "ssim": (_ssim, False),
    "virtual_psnr": (_virtual_psnr, False),
    "encode": (_encode, True),
    "decode": (_decode, True),
}
