"""The scene that is looked at, and the views that judge what becomes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import Camera
from csplat_render.cameras import load_cameras
from csplat_render.lpips import load_lpips
from csplat_tools.compare import BLACK, WHITE, Colour, Distance, comparison_cameras
from csplat_tools.inout import STANDARD_STREAM, ply_path
from csplat_tools.photographs import DataViews, relative_to

if TYPE_CHECKING:
    from csplat_trainer.pictures import Picture

__all__ = ["Inputs", "Setting", "read_setting"]


_VIRTUAL = "virtual"


@dataclass(frozen=True)
class Inputs:
    """What is read.

    Attributes:
        source: a PLY, or `-`.
        data: a data set whose held-out photographs judge, and whose other ones decide what simplification removes and
            teach fine-tuning.
        cameras: instead, a camera file: views that judge.
        lpips: a file of LPIPS weights, or `auto`; it is not computed if left out.
    """

    source: str
    data: DataViews | None = None
    cameras: str | None = None
    lpips: str | None = None


@dataclass(frozen=True, eq=False)
class Setting:
    """A scene, and by what its files are judged.

    Attributes:
        name: of the PLY. source: its splats. source_bytes: its size.
        findings: what lint noticed in it.
        cameras: views that judge, relative to the source's origin. cameras_name: where they come from.
        background: of all pictures.
        photographs: what was photographed there, if anything.
        data: the data set that they come from.
        deciding: cameras by which simplification chooses: never those that judge; `None` for virtual ones.
        distance: LPIPS, if wanted.
    """

    name: str
    source: SplatModel
    source_bytes: int
    findings: Sequence[Finding]
    cameras: Sequence[Camera]
    cameras_name: str
    background: Colour = BLACK
    photographs: Sequence[Picture] | None = None
    data: DataViews | None = None
    deciding: Sequence[Camera] | None = None
    distance: Distance | None = None

    @property
    def own_cameras(self) -> Sequence[Camera] | None:
        """The views that judge; `None` where they are those of `psnr`, which the source itself chooses."""
        return None if self.cameras_name == _VIRTUAL else self.cameras


def read_setting(inputs: Inputs, *, deciding: bool) -> Setting:
    """Read scene and views.

    Args:
        inputs: where they are.
        deciding: the training cameras of a data set are wanted, too.

    Raises:
        CsplatError: a file is not valid, or no splat is left of it.
        OSError: it cannot be read.
    """
    if inputs.data is not None and inputs.cameras is not None:
        raise InputError("wanted cameras of a file or of a data set, not both")
    distance = None if inputs.lpips is None else load_lpips(None if inputs.lpips == "auto" else inputs.lpips)
    given = None if inputs.cameras is None else load_cameras(inputs.cameras)
    findings: list[Finding] = []
    with ply_path(inputs.source) as path:
        source = read_ply(path, report=findings)
        source_bytes = path.stat().st_size
    if not len(source):
        raise InputError("a scene without splats has nothing to trade")
    name = "standard input" if inputs.source == STANDARD_STREAM else Path(inputs.source).name
    if inputs.data is None:
        cameras = comparison_cameras(source) if given is None else given
        named = _VIRTUAL if inputs.cameras is None else Path(inputs.cameras).name
        if not cameras:
            raise InputError(f"{named}: there is no camera to judge from")
        return Setting(name, source, source_bytes, findings, cameras, named, distance=distance)
    photographs = inputs.data.read()
    training = _training_cameras(inputs.data, source) if deciding else None
    return Setting(
        name, source, source_bytes, findings,
        cameras=[relative_to(source.origin, one.camera) for one in photographs],
        cameras_name=Path(inputs.data.path).resolve().name,
        background=WHITE if any(one.has_alpha for one in photographs) else BLACK,
        photographs=photographs,
        data=inputs.data,
        deciding=training,
        distance=distance,
    )  # fmt: skip


def _training_cameras(data: DataViews, source: SplatModel) -> list[Camera]:
    training = DataViews(data.path, "train", data.size, data.images, data.test_every)
    return [relative_to(source.origin, one.camera) for one in training.read()]
