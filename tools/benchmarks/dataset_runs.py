"""One benchmark scene: train it or take what was trained, score it, encode it, score the decoded files."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from dataset_folders import TEST_EVERY, PictureChoice, SceneFolder, choose_pictures
from numpy.typing import NDArray

import csplat
from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply
from csplat_render.camera import Camera
from csplat_render.cameras import relative_to
from csplat_render.lpips import Lpips
from csplat_render.rasterise import Rasteriser
from csplat_trainer.data import DataSet, load
from csplat_trainer.evaluate import evaluate
from csplat_trainer.loop import train
from csplat_trainer.options import TrainOptions
from csplat_trainer.pictures import Picture, compose
from csplat_trainer.report import Progress, save_picture, side_by_side

__all__ = ["PLY", "Settings", "run_scene"]

F32 = NDArray[np.float32]

#: What the trained scene is called among its compressed ones.
PLY = "PLY"

_TOLD = 10  # lines of progress per training
_TRAINING = ("iterations", "max_splats", "sh_degree", "seed", "device")


@dataclass(frozen=True)
class Settings:
    """What the command line asks for.

    Attributes:
        iterations, max_splats, sh_degree, seed, device: of the training.
        size: exact size of all pictures, or `None`.
        downscale: sides of the papers' pictures are divided by this.
        presets: of the encoder.
        pictures: how many test views are written beside their photographs, per scene.
        force: train again what is trained.
        rescore: encode and score again what is scored.
    """

    iterations: int
    max_splats: int
    sh_degree: int
    seed: int
    device: str
    size: tuple[int, int] | None
    downscale: float
    presets: tuple[str, ...]
    pictures: int
    force: bool
    rescore: bool


def run_scene(
    folder: SceneFolder, settings: Settings, out: Path, lpips: Lpips | None, tell: Callable[[str], object]
) -> dict[str, Any]:
    """Make one row of the table; `out` gets KEY.ply, KEY.json and KEY/VIEW.png.

    A scene whose PLY is there is not trained again: KEY.json says how it was trained. A PLY without one was trained by
    somebody else, and is scored all the same.

    Args:
        folder: the scene.
        settings: see there.
        out: an existing folder.
        lpips: weights, or `None`: not measured.
        tell: gets lines for the user.

    Returns:
        What KEY.json holds: JSON-compatible.

    Raises:
        CsplatError: the data set is damaged or has no test pictures, or the PLY is not valid.
    """
    ply, record_path = out / f"{folder.key}.ply", out / f"{folder.key}.json"
    record = _read_record(record_path) if ply.exists() and not settings.force else None
    if record is None:
        choice = choose_pictures(folder, settings.size, settings.downscale)
        record = _begin(folder, choice)
        if ply.exists() and not settings.force:
            tell(f"{folder.title}: {ply} was trained elsewhere, and is scored on pictures as chosen now")
        else:
            record |= _train(folder, record, settings, ply, record_path, tell)
    else:
        _tell_differences(folder, record, settings, tell)
    digest = hashlib.sha256(ply.read_bytes()).hexdigest()
    scoring = {
        "ply_sha256": digest,
        "presets": list(settings.presets),
        "lpips": lpips is not None,
        "pictures": settings.pictures,
        "csplat": csplat.__version__,
    }
    if record.get("scoring") == scoring and not settings.rescore:
        tell(f"{folder.title}: scored before")
        return record
    record |= _score(folder, record, settings, ply, out, lpips, tell)
    record["scoring"] = scoring
    _write_record(record_path, record)
    return record


def _begin(folder: SceneFolder, choice: PictureChoice) -> dict[str, Any]:
    return {
        "key": folder.key,
        "title": folder.title,
        "scene": folder.scene,
        "set": folder.protocol.slug,
        "kind": folder.kind,
        "images": choice.images,
        "size": choice.size,
        "protocol_size": choice.protocol_size,
        "remarks": list(choice.remarks),
        "settings": None,  # not known, unless it is trained here
        "train_seconds": None,
    }


def _train(
    folder: SceneFolder,
    record: dict[str, Any],
    settings: Settings,
    ply: Path,
    record_path: Path,
    tell: Callable[[str], object],
) -> dict[str, Any]:
    data = _load(folder, record)
    for line in (*data.report, *record["remarks"]):
        tell(line)
    options = TrainOptions(
        iterations=settings.iterations,
        max_splats=settings.max_splats,
        sh_degree=settings.sh_degree,
        seed=settings.seed,
        device=settings.device,
    )
    every = max(1, options.iterations // _TOLD // options.log_every) * options.log_every

    def show(now: Progress) -> None:
        if now.iteration % every == 0 or now.iteration == now.iterations:
            tell(
                f"{folder.title}: {now.iteration}/{now.iterations}, PSNR {now.psnr:.2f} dB on training pictures, "
                f"{now.splat_count} splats, {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
            )

    result = train(replace(data, test=[]), options, show)  # the PLY is scored, not what is in memory
    made = {
        "settings": {key: value for key, value in asdict(settings).items() if key in _TRAINING},
        "train_views": len(data.train),
        "train_seconds": result.log["seconds"],
        "peak_memory_bytes": result.log["peak_memory_bytes"],
    }
    # The record first: a PLY without one counts as trained elsewhere.
    _write_record(record_path, {**record, **made})
    write_ply(ply, result.model)
    return made


def _score(
    folder: SceneFolder,
    record: dict[str, Any],
    settings: Settings,
    ply: Path,
    out: Path,
    lpips: Lpips | None,
    tell: Callable[[str], object],
) -> dict[str, Any]:
    data = _load(folder, record)
    if not data.test:
        raise InputError(f"{folder.path} holds out no pictures to score by")
    source = read_ply(ply)
    sheets = _Sheets(out / folder.key, settings.pictures)
    files = [{"file": PLY, "size_bytes": ply.stat().st_size, **_quality(source, data, lpips, sheets)}]
    tell(f"{folder.title}: {files[0]['psnr_mean']:.2f} dB on {len(data.test)} test pictures")
    for preset in settings.presets:
        start = time.perf_counter()
        encoded = encode(source, EncodeOptions(preset=preset))
        seconds = time.perf_counter() - start
        quality = _quality(decode(encoded), data, lpips, sheets)
        files.append({"file": preset, "size_bytes": len(encoded), "encode_seconds": seconds, **quality})
        tell(f"{folder.title}: {preset} {len(encoded) / 1e6:.2f} MB, {quality['psnr_mean']:.2f} dB")
    sheets.write()
    camera = data.test[0].camera
    return {
        "test_views": len(data.test),
        "pixels": [camera.W, camera.H],
        "background": data.background,
        "splats": len(source),
        "sh_degree": source.sh_degree,
        "files": files,
    }


def _load(folder: SceneFolder, record: dict[str, Any]) -> DataSet:
    size = None if record["size"] is None else (int(record["size"][0]), int(record["size"][1]))
    return load(folder.path, size, images=record["images"], test_every=TEST_EVERY)


def _quality(model: SplatModel, data: DataSet, lpips: Lpips | None, sheets: _Sheets) -> dict[str, Any]:
    """Scores of the held-out views as `evaluate` gives them; papers print `psnr_mean`."""
    background = np.array(data.background, np.float32)
    rasteriser = Rasteriser(gradients=False)
    numbers = iter(range(len(data.test)))  # `evaluate` renders them in their order

    def render(camera: Camera) -> F32:
        here = relative_to(model.origin, camera)
        seen = rasteriser.forward(model, here, background=background, antialiased=model.antialiased)
        rendered = seen.rgb.copy()  # the next one overwrites it
        sheets.add(next(numbers), data.test, background, rendered)
        return rendered

    return evaluate(render, data.test, background, lpips)


class _Sheets:
    """Some test views: photograph, render, and renders of the decoded files, side by side.

    Args:
        folder: for the pictures.
        count: of the views, evenly among those held out.
    """

    def __init__(self, folder: Path, count: int) -> None:
        self._folder, self._count = folder, count
        self._panels: dict[str, list[F32]] = {}

    def add(self, number: int, pictures: Sequence[Picture], background: F32, rendered: F32) -> None:
        chosen = {k * len(pictures) // self._count for k in range(self._count)}
        if number not in chosen:
            return
        name = f"{number:03d}_{Path(pictures[number].camera.image or 'view').stem}"
        if name not in self._panels:
            self._panels[name] = [compose(pictures[number], background, np.empty_like(rendered))]
        self._panels[name].append(rendered)

    def write(self) -> None:
        for name, panels in self._panels.items():
            self._folder.mkdir(exist_ok=True)
            save_picture(self._folder / f"{name}.png", side_by_side(*panels))


def _tell_differences(
    folder: SceneFolder, record: dict[str, Any], settings: Settings, tell: Callable[[str], object]
) -> None:
    made = record["settings"]
    if made is None:
        tell(f"{folder.title}: trained elsewhere")
        return
    wanted = {key: value for key, value in asdict(settings).items() if key in _TRAINING}
    choice = choose_pictures(folder, settings.size, settings.downscale)
    if made != wanted or list(choice.size or ()) != list(record["size"] or ()):
        tell(
            f"{folder.title}: trained before with other settings ({made['iterations']} steps, at most "
            f"{made['max_splats']} splats); --force trains it again"
        )
    else:
        tell(f"{folder.title}: trained before")


def _read_record(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    if not isinstance(record, dict) or "settings" not in record or "size" not in record:
        raise InputError(f"{path} is no record of this program")
    return record


def _write_record(path: Path, record: dict[str, Any]) -> None:
    with atomic_writer(path) as stream:
        stream.write(json.dumps(record, indent=1, allow_nan=False).encode() + b"\n")
