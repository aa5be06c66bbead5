"""One benchmark scene: train it or take what was trained, score it, encode it, score the decoded files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import csplat
from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.captures import read_training, train_to
from csplat_bench.common.command import preset_of
from csplat_bench.common.kept import file_digest
from csplat_bench.common.measuring import timed
from csplat_bench.common.report import write_json
from csplat_bench.datasets.folders import TEST_EVERY, SceneFolder, choose_pictures
from csplat_bench.datasets.records import File, Record
from csplat_render.lpips import Lpips
from csplat_tools.console import note
from csplat_trainer.data import DataSet, load
from csplat_trainer.posed_images import image_scorer
from csplat_trainer.training_options import TrainOptions

#: Name of the trained scene among its compressed files.
PLY = "PLY"


@dataclass(frozen=True)
class Settings:
    """Settings from the command line.

    Attributes:
        training: options for training scenes.
        size: exact width and height of all images, or `None`.
        downscale: divisor of the width and height that the papers use.
        presets: presets of the encoder.
        force: train scenes again that are already trained.
        rescore: encode and score files again that are already scored.
    """

    training: TrainOptions
    size: tuple[int, int] | None
    downscale: float
    presets: tuple[str, ...]
    force: bool
    rescore: bool


def run_scene(folder: SceneFolder, settings: Settings, out: Path, lpips: Lpips | None) -> Record:
    """Make one row of the table; `out` gets KEY.ply, KEY.training.json and KEY.json, which is what comes back.

    A scene whose PLY is there is not trained again, and is scored on the pictures that it was trained on. A PLY that
    is not known to be trained here was trained by somebody else, and is scored all the same.

    Args:
        folder: the scene.
        settings: see there.
        out: a folder.
        lpips: weights, or `None`: not measured.

    Raises:
        CsplatError: the data set is damaged or has no test pictures, or the PLY is not valid.
    """
    ply, path = out / f"{folder.key}.ply", out / f"{folder.key}.json"
    there = ply.exists() and not settings.force
    record = _read_record(path) if there and path.exists() else _begun(folder, settings)
    data = _load(folder, record)
    training = read_training(ply) if there else {}
    if not there:
        for line in (*data.report, *record["remarks"]):
            note(line)
        write_json(path, record)
        training = train_to(ply, data, settings.training)
    elif not training:
        note(f"{folder.title}: trained elsewhere")
    elif training["options"] != asdict(settings.training) or _begun(folder, settings)["size"] != record["size"]:
        options = training["options"]
        note(
            f"{folder.title}: trained before with other settings ({options['iterations']} steps, at most "
            f"{options['max_splats']} splats); --force trains it again"
        )
    else:
        note(f"{folder.title}: trained before")
    scoring = {
        "ply_sha256": file_digest(ply),
        "presets": list(settings.presets),
        "lpips": lpips is not None,
        "csplat": csplat.__version__,
    }
    if record.get("scoring") == scoring and not settings.rescore:
        note(f"{folder.title}: scored before")
        return record
    if training:
        record |= {"settings": training["options"], "train_views": training["views"]}
        record["train_seconds"] = training["seconds"]
    record |= _scored(folder, data, settings, ply, lpips)
    record["scoring"] = scoring
    write_json(path, record)
    return record


def _begun(folder: SceneFolder, settings: Settings) -> Record:
    choice = choose_pictures(folder, settings.size, settings.downscale)
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


def _scored(folder: SceneFolder, data: DataSet, settings: Settings, ply: Path, lpips: Lpips | None) -> Record:
    if not data.test:
        raise InputError(f"{folder.path} holds out no pictures to score by")
    source = read_ply(ply)
    files = [_file(PLY, source, ply.stat().st_size, None, data, lpips)]
    for preset in settings.presets:
        encoded, timing = timed(encode, source, EncodeOptions(preset=preset_of(preset)))
        files.append(_file(preset, decode(encoded), len(encoded), timing.wall, data, lpips))
    for one in files:
        note(f"{folder.title}: {one['file']} {one['size_bytes'] / 1e6:.2f} MB, {one['psnr_mean']:.2f} dB")
    camera = data.test[0].camera
    return {
        "test_views": len(data.test),
        "pixels": (camera.W, camera.H),
        "background": data.background,
        "splats": len(source),
        "sh_degree": source.sh_degree,
        "files": files,
    }


def _file(
    name: str, model: SplatModel, size_bytes: int, seconds: float | None, data: DataSet, lpips: Lpips | None
) -> File:
    """Score a model on the held-out pictures; papers print the mean over them."""
    found = image_scorer(data.test, data.background, origin=(0.0, 0.0, 0.0)).scores(model, lpips=lpips)
    return {
        "file": name,
        "size_bytes": size_bytes,
        "encode_seconds": seconds,
        "psnr_mean": found.psnr_mean,
        "ssim": found.ssim,
        "lpips": found.lpips,
    }


def _load(folder: SceneFolder, record: Record) -> DataSet:
    return load(folder.path, record["size"], images=record["images"], test_every=TEST_EVERY)


def _read_record(path: Path) -> Record:
    try:
        record: Record = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    if not isinstance(record, dict) or "settings" not in record or "size" not in record:
        raise InputError(f"{path} is no record of this program")
    size = record["size"]
    record["size"] = None if size is None else (size[0], size[1])
    return record
