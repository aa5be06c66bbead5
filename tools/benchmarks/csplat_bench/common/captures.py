"""Scenes with photographs, and splats that were trained on them, here or before."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

from csplat.errors import InputError
from csplat.ply import write_ply
from csplat_bench.common.report import write_json
from csplat_bench.common.scenes import DATA
from csplat_tools.console import note
from csplat_trainer.data import DataSet, load
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions
from csplat_trainer.training_report import TrainingStep

_TOLD = 5  # lines of progress of a training


class Training(TypedDict, total=False):
    """A record of how splats were trained; empty if unknown."""

    options: dict[str, Any]
    seconds: float
    splats: int
    views: int


@dataclass(frozen=True)
class Capture:
    """A scene with its photographs.

    Attributes:
        name: name in tables and file names.
        data: the data set.
        size: width and height of the photographs; `None`: as they are.
        ply: the splats; `None`: they are trained by `training`.
        training: options of its training, if the data set is available.
    """

    name: str
    data: Path
    size: tuple[int, int] | None
    ply: Path | None = None
    training: TrainOptions | None = None

    @cached_property
    def background(self) -> tuple[float, float, float]:
        """Behind everything, in training and after: what suits the data set."""
        return load(self.data, self.size).background


_IMAGES = DATA / "images"
_LEGO = TrainOptions(iterations=30_000)

#: By name. `fox` is trained on the photographs of `fox120k`, so that its training has a time.
CAPTURES = {
    one.name: one
    for one in (
        *(
            Capture(name, _IMAGES / "lego200", (200, 200), training=replace(_LEGO, max_splats=count))
            for name, count in (("lego1k", 1_000), ("lego20k", 20_000), ("lego50k", 50_000))
        ),
        Capture("fox120k", _IMAGES / "fox", (270, 480), DATA / "ply" / "fox120k.ply"),
        Capture("fox", _IMAGES / "fox", (270, 480), training=TrainOptions(max_splats=120_000, iterations=7_000)),
        Capture("desk29", _IMAGES / "desk29", (476, 268), training=TrainOptions(max_splats=40_000, iterations=10_000)),
    )
}


def choose_captures(names: Sequence[str], extra: Sequence[str] = ()) -> list[Capture]:
    """The scenes that a command line names.

    Args:
        names: keys of `CAPTURES`.
        extra: further ones as NAME,PLY,DATA,WxH; `-` for WxH: photographs as they are.

    Raises:
        InputError: a name is not known, or a file is not there.
    """
    unknown = sorted(set(names) - set(CAPTURES))
    if unknown:
        raise InputError(f"no scene is called {', '.join(unknown)}, wanted some of {', '.join(CAPTURES)}")
    found = [CAPTURES[name] for name in names]
    found += map(_extra, extra)
    for one in found:
        for path in (one.data, one.ply):
            if path is not None and not path.exists():
                raise InputError(f"{one.name}: {path} does not exist")
    return found


def _extra(text: str) -> Capture:
    try:
        name, ply, data, pixels = text.split(",")
        width, height = (None, None) if pixels == "-" else map(int, pixels.split("x"))
    except ValueError:
        raise InputError(f"a further scene is {text!r}, wanted NAME,PLY,DATA,WxH") from None
    size = None if width is None or height is None else (width, height)
    return Capture(name, Path(data), size, Path(ply))


def trained(capture: Capture, out: Path) -> tuple[Path, Training]:
    """The PLY of a capture, trained if there is none, and how.

    Args:
        capture: the scene.
        out: gets NAME.ply and NAME.training.json.

    Raises:
        InputError: the data set is damaged, or it is not known how to train the scene.
    """
    if capture.ply is not None:
        return capture.ply, {}
    if capture.training is None:
        raise InputError(f"{capture.name} has neither splats nor a way to train them")
    path = out / f"{capture.name}.ply"
    known = read_training(path)
    if path.exists() and known:
        if known["options"] == asdict(capture.training):
            return path, known
        raise InputError(f"{path} was trained with other options: name another --out, or remove it")
    return path, train_to(path, load(str(capture.data), capture.size), capture.training)


def train_to(ply: Path, data: DataSet, options: TrainOptions) -> Training:
    """Train a scene and write its PLY and, next to it, how it was trained."""
    every = max(1, options.iterations // _TOLD // options.log_every) * options.log_every

    def show(now: TrainingStep) -> None:
        if now.iteration % every == 0:
            note(f"{ply.stem}: {now.iteration}/{now.iterations}, {now.splat_count} splats, {now.seconds:.0f} s")

    result = train(replace(data, test=[]), options, on_step=show)
    log = result.log
    training: Training = {
        "options": asdict(options), "seconds": log["seconds"], "splats": len(result.model), "views": len(data.train),
    }  # fmt: skip
    # The record of the training first: a PLY without one counts as trained elsewhere.
    write_json(ply.with_suffix(".training.json"), training)
    write_ply(ply, result.model)
    return training


def read_training(ply: Path) -> Training:
    """Return how a PLY was trained, from the JSON file next to it; empty if there is none."""
    path = ply.with_suffix(".training.json")
    if not path.exists():
        return {}
    known: Training = json.loads(path.read_text())
    return known
