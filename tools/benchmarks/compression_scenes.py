"""The scenes that compression is measured on: photographs, and splats that were trained on them, here or before."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from scenes import DATA

from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.ply import write_ply
from csplat_trainer.data import load
from csplat_trainer.loop import train
from csplat_trainer.options import TrainOptions
from csplat_trainer.report import Progress

__all__ = ["SCENES", "Kept", "Scene", "choose_scenes", "file_digest", "trained"]

_TOLD = 5  # lines of progress of a training


@dataclass(frozen=True)
class Scene:
    """A scene with its photographs.

    Attributes:
        name: what tables and files call it.
        data: the data set.
        size: width and height of the photographs; `None`: as they are.
        ply: the splats; `None`: they are trained by `training`.
        training: how, if the data set is at hand.
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


def _lego(count: int) -> Scene:
    options = TrainOptions(max_splats=count, iterations=30_000)
    return Scene(f"lego{count // 1000}k", DATA / "images" / "lego200", (200, 200), training=options)


_FOX = Scene("fox120k", DATA / "images" / "fox", (270, 480), DATA / "ply" / "fox120k.ply")

#: By name. `fox` is trained on the photographs of `fox120k`, so that its training has a time.
SCENES = {
    one.name: one
    for one in (
        _lego(1_000),
        _lego(20_000),
        _lego(50_000),
        _FOX,
        replace(
            _FOX, name="fox", ply=None,
            training=TrainOptions(max_splats=120_000, iterations=7_000),
        ),
        Scene(
            "desk29", DATA / "images" / "desk29", (476, 268),
            training=TrainOptions(max_splats=40_000, iterations=10_000),
        ),
    )
}  # fmt: skip


def choose_scenes(
    names: list[str], plys: list[str], extra: list[list[str]], iterations: int | None = None
) -> list[Scene]:
    """The scenes that a command line names.

    Args:
        names: keys of `SCENES`.
        plys: NAME=FILE, splats that stand for those that would be trained.
        extra: each [NAME, PLY, DATA, WxH]: further scenes; `-` for WxH as they are.
        iterations: training steps of those that are trained; `None`: as each scene has them.

    Raises:
        InputError: a name is not known, or a file is not there.
    """
    given = dict(text.partition("=")[::2] for text in plys)
    for name in (*names, *given):
        if name not in SCENES:
            raise InputError(f"no scene is called {name!r}, wanted some of {', '.join(SCENES)}")
    scenes = [replace(SCENES[name], ply=Path(given[name]) if name in given else SCENES[name].ply) for name in names]
    if iterations is not None:
        scenes = [
            one if one.training is None else replace(one, training=replace(one.training, iterations=iterations))
            for one in scenes
        ]
    scenes += [Scene(name, Path(data), _size(name, size), Path(ply)) for name, ply, data, size in extra]
    for one in scenes:
        for path in (one.data, one.ply):
            if path is not None and not path.exists():
                raise InputError(f"{one.name}: {path} does not exist")
    return scenes


def _size(name: str, text: str) -> tuple[int, int] | None:
    if text == "-":
        return None
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise InputError(f"the size of {name} is {text!r}, wanted width and height, as 640x480")
    return int(width), int(height)


def trained(scene: Scene, out: Path, tell: Callable[[str], object]) -> tuple[Path, dict[str, Any]]:
    """The scene's PLY, trained if there is none, and how long that took.

    Args:
        scene: the scene.
        out: an existing folder, which gets NAME.ply and NAME.training.json.
        tell: gets lines for the user.

    Returns:
        The file; options and seconds of the training, {} where it is not known.

    Raises:
        InputError: the data set is damaged, or it is not known how to train the scene.
    """
    if scene.ply is not None:
        return scene.ply, {}
    if scene.training is None:
        raise InputError(f"{scene.name} has neither splats nor a way to train them")
    path, log = out / f"{scene.name}.ply", out / f"{scene.name}.training.json"
    if path.exists() and log.exists():
        facts: dict[str, Any] = json.loads(log.read_text())
        if facts["options"] == asdict(scene.training):
            return path, facts
        raise InputError(f"{path} was trained with other options: name another --out, or remove it")
    data = load(str(scene.data), scene.size)
    every = max(1, scene.training.iterations // _TOLD // scene.training.log_every) * scene.training.log_every

    def show(now: Progress) -> None:
        if now.iteration % every == 0:
            tell(f"{scene.name}: {now.iteration}/{now.iterations}, {now.splat_count} splats, {now.seconds:.0f} s")

    result = train(replace(data, test=[]), scene.training, show)
    facts = {"options": asdict(scene.training), "seconds": result.log["seconds"], "splats": len(result.model)}
    write_ply(path, result.model)
    _write(log, facts)
    return path, facts


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Kept:
    """Results of a scene, on disk after each one: a run that is interrupted goes on. Owns the file.

    Args:
        path: of the file.
        settings: whatever results depend on; JSON-compatible.
        tell: gets lines for the user.

    Raises:
        InputError: what is on disk was measured with other settings.
    """

    def __init__(self, path: Path, settings: dict[str, Any], tell: Callable[[str], object]) -> None:
        self.path, self._tell = path, tell
        self.values: dict[str, Any] = {"settings": settings}
        if path.exists():
            self.values = json.loads(path.read_text())
            known = self.values.get("settings", {})
            for name, value in settings.items():
                if known.get(name) != value:
                    raise InputError(
                        f"{path} was measured with {name} {known.get(name)}, wanted {value}: name another --out"
                    )

    def knows(self, kind: str, key: str) -> bool:
        """Whether that was measured."""
        return key in self.values.get(kind, {})

    def measure(self, kind: str, key: str, call: Callable[[], Any]) -> Any:
        """Return what is known, or find it out and keep it."""
        known = self.values.setdefault(kind, {})
        if key not in known:
            start = time.perf_counter()
            known[key] = call()
            _write(self.path, self.values)
            self._tell(f"{self.path.stem} {kind} {key}: {time.perf_counter() - start:.0f} s")
        return known[key]


def _write(path: Path, document: dict[str, Any]) -> None:
    with atomic_writer(path) as stream:
        stream.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")
