"""`ViewSet`: from where a scene is looked at, and for what: views that teach, that decide, that judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat_render import Camera, Mode
from csplat_render.judge import Drawable, Judge

if TYPE_CHECKING:
    from csplat_trainer.pictures import Picture

__all__ = ["BLACK", "SPLITS", "VIRTUAL", "WHITE", "Colour", "Split", "ViewSet", "counted_views", "pose"]

Colour = tuple[float, float, float]

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)

#: The name of a set whose judging views are virtual: those of `psnr`.
VIRTUAL = "virtual"

#: Parts of a data set: the photographs that were held out of training, and the others.
Split = Literal["test", "train"]
SPLITS: tuple[Split, ...] = get_args(Split)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """Views of a scene. None has two roles: what was chosen by a view looks better there than elsewhere.

    Attributes:
        name: where the judging views come from: `virtual`, or the name of a camera file or of a data set.
        background: red, green, blue behind everything that teaches and decides; behind what judges, too, unless that
            is virtual: `psnr` is on black.
        teaches: what values are fitted to, and from where it is measured what splats are worth.
        decides: what says how many splats stay, which step was best, when there is enough.
        judges: what the scores in reports are about.
        photographs: of a data set, in its order; each holds its camera, one of those above.
        virtual: whether the views that teach and decide were placed around the scene by us.
        origin: what all cameras are relative to: the scene's.
        notes: what the user should know of how the set came about, a line each.
        split: which photographs of a data set judge: those that were held out, or those of the training.

    Raises:
        InputError: a view has two roles.
    """

    name: str
    background: Colour
    teaches: Sequence[Camera]
    decides: Sequence[Camera]
    judges: Sequence[Camera]
    photographs: Sequence[Picture] = ()
    virtual: bool = False
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    split: Split = "test"

    def __post_init__(self) -> None:
        seen: dict[bytes, str] = {}
        for role in ("teaches", "decides", "judges"):
            for camera in getattr(self, role):
                other = seen.setdefault(pose(camera), role)
                if other != role:
                    raise InputError(f"{self.name}: a view both {other} and {role}")

    @property
    def judging_background(self) -> Colour:
        """What is behind everything where the views that judge look."""
        return BLACK if self.name == VIRTUAL else self.background

    def judge(
        self,
        source: SplatModel | Drawable,
        *,
        background: Colour | None = None,
        mode: Mode = "standard",
        threads: int | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Judge:
        """What judges by renders of the source.

        Args:
            source: the scene.
            background: another one than is said above.
            mode, threads: of the renderer.
            progress: is told how much of the source is drawn.

        Raises:
            InputError: no view judges.
        """
        colour = background or self.judging_background
        return Judge.of_source(source, self.judges, colour, mode=mode, threads=threads, progress=progress)

    def decider(self, source: SplatModel, *, threads: int | None = None) -> Judge:
        """What decides by renders of the source.

        Raises:
            InputError: no view decides.
        """
        return Judge.of_source(source, self.decides, self.background, threads=threads)

    def photograph_judge(self, *, mode: Mode = "standard", threads: int | None = None) -> Judge:
        """What judges by photographs.

        Raises:
            InputError: there are none, or none judges.
        """
        return self._by_photographs(self.judges, mode, threads)

    def photograph_decider(self, *, threads: int | None = None) -> Judge:
        """What decides by photographs.

        Raises:
            InputError: there are none, or none decides.
        """
        return self._by_photographs(self.decides, "standard", threads)

    def pictures(self, cameras: Sequence[Camera]) -> list[Picture]:
        """The photographs that some of the cameras took, in their order."""
        taken = {id(one.camera): one for one in self.photographs}
        return [taken[id(camera)] for camera in cameras]

    def read(self) -> None:
        """Read all photographs now, so that a damaged one is found before minutes are spent on the others.

        Raises:
            InputError: a file is no image, or is cut short.
        """
        for photograph in self.photographs:
            _ = photograph.pixels, photograph.mask

    def _by_photographs(self, cameras: Sequence[Camera], mode: Mode, threads: int | None) -> Judge:
        from csplat_trainer.evaluate import photograph_judge

        if not self.photographs:
            raise InputError("there are no photographs: name a data set")
        shown = self.pictures(cameras)
        return photograph_judge(shown, self.background, mode=mode, threads=threads, origin=self.origin)


def counted_views(count: int, name: str) -> str:
    """How many views there are and where they come from: `8 virtual views`, `8 views of lego`.

    Args:
        count: how many.
        name: of the set.
    """
    return counted(count, "virtual view") if name == VIRTUAL else f"{counted(count, 'view')} of {name}"


def pose(camera: Camera) -> bytes:
    """What tells a view from others, whatever the size of its picture: where it stands, and what it takes in."""
    lens = camera.K[:2] / np.array([[camera.W], [camera.H]])
    return (np.round(np.concatenate([camera.viewmat[:3].ravel(), lens.ravel()]), 9) + 0.0).tobytes()
