"""Find benchmark scenes below a folder, and decide which of their pictures are used, in which size."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from csplat.errors import InputError
from csplat_bench.common.command import listed
from csplat_bench.datasets.protocols import BLENDER, COLMAP, MAX_WIDTH, OTHER, PROTOCOLS, TRANSFORMS, Protocol
from csplat_tools.console import note
from csplat_trainer.data.colmap import find_model, read_colmap
from csplat_trainer.data.dataset import UnreadDataSet
from csplat_trainer.data.image_pixels import image_size
from csplat_trainer.data.transforms import read_blender, read_transforms

#: If a set does not name its test images, every Nth image is one.
TEST_EVERY = 8

_DEPTH = 5  # folders below the one that is named
_FOREIGN = ("llff",)  # sets that have scenes of the same names
_RESOLUTION = r"([_-]?\d+(x\d+)?)?"  # lego200, lego_400x400


@dataclass(frozen=True)
class SceneFolder:
    """A scene on disk.

    Attributes:
        path: its folder.
        kind: `COLMAP`, `BLENDER` or `TRANSFORMS`.
        protocol: the benchmark set it belongs to; `OTHER` for any other.
        scene: its name in the set's tables; the folder's if there are none.
        key: names its files; no two scenes have the same.
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
class PictureChoice:
    """The images that are used of a scene.

    Attributes:
        images: COLMAP: name of the folder; `None`: the smallest that is large enough for `size`.
        size: width and height that they are resized to; `None`: not resized.
        protocol_size: size that the papers use, if known; otherwise the images' own size.
        remarks: lines for the user.
    """

    images: str | None
    size: tuple[int, int] | None
    protocol_size: tuple[int, int]
    remarks: tuple[str, ...] = ()


def find_scene_folders(root: Path) -> list[SceneFolder]:
    """Find all scenes that the trainer's readers recognise, in a folder itself or some folders below.

    Folders that look like a scene but are none are reported to the user.

    Returns:
        Scenes of the benchmark sets first, in the order of their tables.

    Raises:
        InputError: there is no such folder, or no scene in it.
    """
    if not root.is_dir():
        raise InputError(f"{root} is not a folder")
    found = list(_walk(root, _DEPTH))
    if not found:
        raise InputError(
            f"no data set in {root}: wanted folders with sparse/0 beside images, images_2 or images_4 (Mip-NeRF 360, "
            "Tanks and Temples, Deep Blending), with transforms_train.json (NeRF-synthetic), or with transforms.json"
        )
    known = [(protocol.slug, scene) for protocol in PROTOCOLS for scene in protocol.factors]
    position = {name: number for number, name in enumerate(known)}
    found.sort(key=lambda one: (position.get((one.protocol.slug, one.scene), len(known)), str(one.path)))
    return _with_unique_keys(found)


def choose_scenes(found: list[SceneFolder], names: str | None) -> list[SceneFolder]:
    """Pick scenes by the names of their folders, of their tables, or their keys, separated by commas.

    Raises:
        InputError: a name fits none.
    """
    if names is None:
        return found
    wanted = listed(names.lower())
    labels = {one.key: {one.title.lower(), one.scene, one.key.lower()} for one in found}
    for name in wanted:
        if not any(name in own for own in labels.values()):
            raise InputError(f"there is no scene {name}; found {', '.join(one.title for one in found)}")
    return [one for one in found if labels[one.key] & set(wanted)]


def choose_pictures(folder: SceneFolder, size: tuple[int, int] | None, downscale: float) -> PictureChoice:
    """Decide on folder and size of the images: as in the papers, unless the user asks otherwise.

    Args:
        folder: the scene.
        size: exact width and height, or `None`.
        downscale: both sides of the papers' pictures are divided by this, 1 or more.

    Raises:
        InputError: the set is damaged.
    """
    factor = folder.protocol.factors.get(folder.scene, 1)
    images, found = _pictures(folder, factor)
    sizes = {image_size(shot.path) for shot in (*found.train, *found.test)}
    own = image_size((found.train or found.test)[0].path)
    scaled_here = factor if images == "images" else 1  # there is no folder of that size: scale the large ones
    wanted = _scaled(own, max(scaled_here, own[0] / MAX_WIDTH))
    chosen = size or _scaled(wanted, downscale)
    remarks = []
    if scaled_here > 1:
        remarks.append(f"there is no images_{factor}: the pictures are scaled down here")
    if chosen == own and len(sizes) == 1:
        return PictureChoice(images, None, wanted, tuple(remarks))
    if len(sizes) > 1:
        if chosen == own:
            return PictureChoice(images, None, wanted, (*remarks, f"pictures of {len(sizes)} sizes, used as they are"))
        remarks.append(f"pictures of {len(sizes)} sizes are all brought to {chosen[0]}×{chosen[1]}")
    return PictureChoice(images, chosen, wanted, tuple(remarks))


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
    note(f"{folder} is left out: a COLMAP model without a folder of pictures")
    return None


def _scene(folder: Path, kind: str) -> SceneFolder:
    name = folder.resolve().name.lower()
    foreign = any(word in part.lower() for part in folder.resolve().parts[:-1] for word in _FOREIGN)
    for protocol in PROTOCOLS if not foreign else ():
        for scene in protocol.factors if protocol.kind == kind else ():
            # Blender sets are kept in several sizes; a photographed room2 is another room.
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


def _pictures(folder: SceneFolder, factor: int) -> tuple[str | None, UnreadDataSet]:
    if folder.kind == BLENDER:
        return None, read_blender(folder.path)
    if folder.kind == TRANSFORMS:
        return None, read_transforms(folder.path / "transforms.json", TEST_EVERY)
    images = f"images_{factor}" if (folder.path / f"images_{factor}").is_dir() else "images"
    if not (folder.path / images).is_dir():
        raise InputError(f"{folder.path} has neither images nor images_{factor}")
    model = find_model(folder.path)
    assert model is not None
    return images, read_colmap(folder.path, model[0], None, images, TEST_EVERY)


def _scaled(size: tuple[int, int], divisor: float) -> tuple[int, int]:
    return max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))
