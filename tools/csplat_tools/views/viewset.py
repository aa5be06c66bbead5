"""`ViewSet`: the training, validation and test views of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat_render import Camera, Mode
from csplat_render.scorer import Renderable, Scorer

if TYPE_CHECKING:
    from csplat_trainer.posed_images import PosedImage


Colour = tuple[float, float, float]

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)

#: Name of a set whose test views are virtual: those of `psnr`.
VIRTUAL = "virtual"

#: Parts of a data set: the photographs that were held out of training, and the others.
Split = Literal["test", "train"]
SPLITS: tuple[Split, ...] = get_args(Split)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """The views of a scene by role. No view has two roles: a choice made by a view looks better there than elsewhere.

    Attributes:
        name: source of the test views: `virtual`, or the name of a camera file or of a data set.
        background: red, green, blue behind training and validation views; behind test views, too, unless they are
            virtual: `psnr` is on black.
        teaches: training views, to which values are fitted, and from which importance is measured.
        decides: validation views, by which the number of splats, the best step and the end of a search are chosen.
        judges: test views, to which the scores in reports refer.
        photographs: photographs of a data set, in its order; each has its camera, one of those above.
        virtual: training and validation views were placed around the scene by csplat.
        origin: the scene's origin, to which all cameras are relative.
        notes: remarks for the user on the choice of views, a line each.
        split: the photographs of a data set that are test views: the held-out ones, or those of the training.

    Raises:
        InputError: a view has two roles.
    """

    name: str
    background: Colour
    teaches: Sequence[Camera]
    decides: Sequence[Camera]
    judges: Sequence[Camera]
    photographs: Sequence[PosedImage] = ()
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
        """Background colour of the test views."""
        return BLACK if self.name == VIRTUAL else self.background

    def judge(
        self,
        source: SplatModel | Renderable,
        *,
        background: Colour | None = None,
        mode: Mode = "standard",
        threads: int | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Scorer:
        """Return the scorer by the source's renders in the test views.

        Args:
            source: the scene.
            background: a background colour instead of `judging_background`.
            mode, threads: mode of the renderer, and its number of threads.
            progress: progress callback of rendering the source.

        Raises:
            InputError: there are no test views.
        """
        colour = background or self.judging_background
        return Scorer.of_source(source, self.judges, colour, mode=mode, threads=threads, progress=progress)

    def decider(self, source: SplatModel, *, threads: int | None = None) -> Scorer:
        """Return the scorer by the source's renders in the validation views.

        Raises:
            InputError: there are no validation views.
        """
        return Scorer.of_source(source, self.decides, self.background, threads=threads)

    def photograph_judge(self, *, mode: Mode = "standard", threads: int | None = None) -> Scorer:
        """Return the scorer by the photographs of the test views.

        Raises:
            InputError: there are no photographs, or no test views.
        """
        return self._by_photographs(self.judges, mode, threads)

    def photograph_decider(self, *, threads: int | None = None) -> Scorer:
        """Return the scorer by the photographs of the validation views.

        Raises:
            InputError: there are no photographs, or no validation views.
        """
        return self._by_photographs(self.decides, "standard", threads)

    def pictures(self, cameras: Sequence[Camera]) -> list[PosedImage]:
        """Return the photographs that the given cameras took, in the order of the cameras."""
        taken = {id(one.camera): one for one in self.photographs}
        return [taken[id(camera)] for camera in cameras]

    def read(self) -> None:
        """Read all photographs now, so that a damaged one is found before minutes are spent on the others.

        Raises:
            InputError: a file is not an image, or is truncated.
        """
        for photograph in self.photographs:
            _ = photograph.pixels, photograph.mask

    def _by_photographs(self, cameras: Sequence[Camera], mode: Mode, threads: int | None) -> Scorer:
        from csplat_trainer.posed_images import photograph_scorer

        if not self.photographs:
            raise InputError("there are no photographs: name a data set")
        shown = self.pictures(cameras)
        return photograph_scorer(shown, self.background, mode=mode, threads=threads, origin=self.origin)


def counted_views(count: int, name: str) -> str:
    """Describe the number of views and their source: `8 virtual views`, `8 views of lego`.

    Args:
        count: number of views.
        name: name of the set.
    """
    return counted(count, "virtual view") if name == VIRTUAL else f"{counted(count, 'view')} of {name}"


def pose(camera: Camera) -> bytes:
    """Return bytes that identify a view at any image size: its pose and its field of view."""
    lens = camera.K[:2] / np.array([[camera.W], [camera.H]])
    return (np.round(np.concatenate([camera.viewmat[:3].ravel(), lens.ravel()]), 9) + 0.0).tobytes()
