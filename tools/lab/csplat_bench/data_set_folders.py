# SPDX-License-Identifier: Apache-2.0
"""Benchmark scenes below a folder, and the images that the papers use of them, by set."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from csplat.errors import InputError
from csplat_tools.console import note
from csplat_trainer.data.colmap import find_model, read_colmap
from csplat_trainer.data.dataset import UnreadDataSet
from csplat_trainer.data.image_pixels import image_size
from csplat_trainer.data.set_folder import SetFolder
from csplat_trainer.data.transforms import read_blender, read_transforms

COLMAP, BLENDER, TRANSFORMS = "COLMAP", "Blender", "transforms.json"

#: Training steps of published figures.
PAPER_STEPS = 30_000

#: If a set does not name its test images, every Nth image is one.
TEST_EVERY = 8

_WIDTH_MAX = 1600  # pixels: the published code of 3DGS scales wider images down to this
_DEPTH = 5  # folders below the root
_FOREIGN = ("llff",)  # sets that have scenes of the same names
_RESOLUTION = r"([_-]?\d+(x\d+)?)?"  # lego200, lego_400x400
_SYNTHETIC_SIZE = (800, 800)  # pixels


@dataclass(frozen=True)
class Protocol:
    """A benchmark set.

    Attributes:
        slug: name in results.
        kind: layout on disk.
        factors: by how much the papers scale the images of a scene down; 4 means the folder `images_4`.
    """

    slug: str
    kind: str | None
    factors: dict[str, int] = field(default_factory=dict)


_OUTDOORS, _INDOORS = ("bicycle", "flowers", "garden", "stump", "treehill"), ("room", "counter", "kitchen", "bonsai")
_SYNTHETIC = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")

#: Mip-NeRF 360, Tanks and Temples, Deep Blending, NeRF-synthetic.
PROTOCOLS = (
    Protocol("mipnerf360", COLMAP, {**dict.fromkeys(_OUTDOORS, 4), **dict.fromkeys(_INDOORS, 2)}),
    Protocol("tandt", COLMAP, dict.fromkeys(("train", "truck"), 1)),
    Protocol("db", COLMAP, dict.fromkeys(("drjohnson", "playroom"), 1)),
    Protocol("synthetic", BLENDER, dict.fromkeys(_SYNTHETIC, 1)),
)

#: All other sets.
OTHER = Protocol("other", None)


@dataclass(frozen=True)
class SceneFolder:
    """A scene on disk.

    Attributes:
        path: its folder.
        kind: `COLMAP`, `BLENDER` or `TRANSFORMS`.
        protocol: its benchmark set; `OTHER` if it belongs to none.
        scene: its name in the papers' tables; the folder's name for other sets.
        key: name in results, unique.
    """

    path: Path
    kind: str
    protocol: Protocol
    scene: str
    key: str

    @property
    def title(self) -> str:
        """The folder's name."""
        return self.path.resolve().name


@dataclass(frozen=True)
class ImageChoice:
    """The images of a scene that are used.

    Attributes:
        images: COLMAP: name of the folder; `None`: the smallest that is large enough for `size`.
        size: width and height that they are resized to; `None`: not resized.
        protocol_size: size that the papers use; for other sets the images' own.
        remarks: lines for the user.
    """

    images: str | None
    size: tuple[int, int] | None
    protocol_size: tuple[int, int]
    remarks: tuple[str, ...] = ()


def find_scene_folders(root: Path) -> list[SceneFolder]:
    """Find all scenes that the trainer's readers recognise, in a folder or below; folders without images are reported.

    Returns:
        Scenes of the benchmark sets first, in the order of their tables.

    Raises:
        InputError: it is not a folder, or holds no scene.
    """
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found = list(_walk(root, _DEPTH))
    if not found:
        raise InputError(
            f"no data set in {root}: expected folders with sparse/0 and images, images_2 or images_4 (Mip-NeRF 360, "
            "Tanks and Temples, Deep Blending), with transforms_train.json (NeRF-synthetic), or with transforms.json"
        )
    known = [(protocol.slug, scene) for protocol in PROTOCOLS for scene in protocol.factors]
    position = {name: number for number, name in enumerate(known)}
    found.sort(key=lambda one: (position.get((one.protocol.slug, one.scene), len(known)), str(one.path)))
    return _with_unique_keys(found)


def choose_scenes(found: Sequence[SceneFolder], names: Sequence[str]) -> list[SceneFolder]:
    """Choose scenes by the names of their folders, of the papers' tables, or their keys.

    Raises:
        InputError: a name matches none.
    """
    labels = {one.key: {one.title.lower(), one.scene, one.key.lower()} for one in found}
    for name in names:
        if not any(name.lower() in own for own in labels.values()):
            raise InputError(f"there is no scene {name}, expected some of {', '.join(one.title for one in found)}")
    return [one for one in found if labels[one.key] & {name.lower() for name in names}]


def choose_images(folder: SceneFolder, size: tuple[int, int] | None, downscale: float) -> ImageChoice:
    """Choose the folder and the size of the images: the papers', unless the user chooses a size.

    Args:
        folder: the scene.
        size: exact width and height, or `None`.
        downscale: divisor of the papers' width and height, 1 or more.

    Raises:
        InputError: the set is not valid.
    """
    factor = folder.protocol.factors.get(folder.scene, 1)
    images, found = _images(folder, factor)
    sizes = {image_size(shot.path) for shot in (*found.train, *found.test)}
    own = image_size((found.train or found.test)[0].path)
    scaled_here = factor if images == "images" else 1  # there is no folder of that size: the large ones are scaled
    papers = _scale(own, max(scaled_here, own[0] / _WIDTH_MAX))
    chosen = size or _scale(papers, downscale)
    remarks = []
    if scaled_here > 1:
        remarks.append(f"there is no images_{factor}: images are scaled here")
    if chosen == own and len(sizes) == 1:
        return ImageChoice(images, None, papers, tuple(remarks))
    if len(sizes) > 1:
        if chosen == own:
            return ImageChoice(images, None, papers, (*remarks, f"images of {len(sizes)} sizes, not scaled"))
        remarks.append(f"images of {len(sizes)} sizes, all scaled to {chosen[0]}×{chosen[1]}")
    return ImageChoice(images, chosen, papers, tuple(remarks))


def _walk(folder: Path, depth: int) -> Iterator[SceneFolder]:
    kind = _kind(folder)
    if kind is not None:
        yield _scene(folder, kind)
    elif depth:
        try:
            inside = sorted(path for path in folder.iterdir() if path.is_dir() and not _is_part(path.name))
        except OSError as error:
            note(f"{folder} is left out: {error.strerror or error}")
            return
        for path in inside:
            yield from _walk(path, depth - 1)


def _is_part(name: str) -> bool:
    """Return True if a folder is hidden, or part of a COLMAP model rather than a scene."""
    return name.startswith(".") or name in ("sparse", "colmap", "distorted")


def _kind(folder: Path) -> str | None:
    """Return a folder's layout, tested in the order used by `csplat_trainer.data.load`; `None` if it is not a scene."""
    if (folder / "transforms_train.json").is_file():
        return BLENDER
    if (folder / "transforms.json").is_file():
        return TRANSFORMS
    if find_model(folder) is None:
        return None
    if any(path.is_dir() and re.fullmatch(r"images(_\d+)?", path.name) for path in folder.iterdir()):
        return COLMAP
    note(f"{folder} is left out: a COLMAP model without a folder of images")
    return None


def _scene(folder: Path, kind: str) -> SceneFolder:
    name = folder.resolve().name.lower()
    foreign = any(word in part.lower() for part in folder.resolve().parts[:-1] for word in _FOREIGN)
    for protocol in PROTOCOLS if not foreign else ():
        for scene in protocol.factors if protocol.kind == kind else ():
            # Blender sets come in several sizes; a photographed room2 is another room.
            pattern = scene + (_RESOLUTION if kind == BLENDER else "")
            if re.fullmatch(pattern, name):
                return SceneFolder(folder, kind, protocol, scene, f"{protocol.slug}-{name}")
    return SceneFolder(folder, kind, OTHER, name, f"{OTHER.slug}-{name}")


def _with_unique_keys(found: list[SceneFolder]) -> list[SceneFolder]:
    counts: dict[str, int] = {}
    result = []
    for one in found:
        counts[one.key] = number = counts.get(one.key, 0) + 1
        result.append(one if number == 1 else replace(one, key=f"{one.key}-{number}"))
    return result


def _images(folder: SceneFolder, factor: int) -> tuple[str | None, UnreadDataSet]:
    place = SetFolder(folder.path)
    if folder.kind == BLENDER:
        return None, read_blender(place)
    if folder.kind == TRANSFORMS:
        return None, read_transforms(place, folder.path / "transforms.json", TEST_EVERY)
    images = f"images_{factor}" if (folder.path / f"images_{factor}").is_dir() else "images"
    if not (folder.path / images).is_dir():
        raise InputError(f"{folder.path} has neither images nor images_{factor}")
    model = find_model(folder.path)
    assert model is not None
    return images, read_colmap(place, model[0], None, images, TEST_EVERY)


def _scale(size: tuple[int, int], divisor: float) -> tuple[int, int]:
    return max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))


def papers_size(folder: SceneFolder, protocol_size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the width and height of the papers' images; `None` for other sets."""
    if folder.protocol is OTHER:
        return None
    return _SYNTHETIC_SIZE if folder.kind == BLENDER else protocol_size
