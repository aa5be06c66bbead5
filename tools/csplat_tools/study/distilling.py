"""Fewer SH bands, whose colours are fitted anew to what the source looks like: the lower degree, distilled.

With the geometry fixed a picture is linear in the coefficients, so the fit is a ridge least-squares problem that
conjugate gradients solve (`csplat_render.refit`); nothing is trained. Few views overfit, far more than in a choice of
splats: 300 splats of wild SH lost 0.7 dB on other views when 28 taught them degree 0, and gained 2.3 when 112 did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.judge import Judge, renderer
from csplat_render.refit import fit_colours
from csplat_tools.files.console import Progress
from csplat_tools.files.scenes import without_bands
from csplat_tools.views import ViewSet, reduced

__all__ = ["Teacher"]

F32 = NDArray[np.float32]
_STEPS = 8  # of conjugate gradients at most; more only follow the views that teach


@dataclass(frozen=True, eq=False)
class Teacher:
    """What a source looks like, for others to learn its colours from.

    Attributes:
        cameras: the views.
        wanted: [H, W, 3], the source's renders there.
        check: judges by views that nothing is fitted to.
        background: red, green, blue behind everything.
        threads: how many; None for all. No result depends on it.
    """

    cameras: Sequence[Camera]
    wanted: Sequence[F32]
    check: Judge
    background: tuple[float, float, float]
    threads: int | None

    @classmethod
    def of_source(
        cls,
        source: SplatModel,
        views: ViewSet,
        *,
        threads: int | None = None,
    ) -> Teacher:
        """Look at a source.

        Args:
            source: the scene.
            views: colours are fitted in those that teach, and checked in those that decide. Pictures are made smaller
                where they are large.
            threads: how many.

        Raises:
            InputError: no view teaches, or none decides.
        """
        if not views.teaches:
            raise InputError("no view is left to learn colours from")
        used, aside = reduced(views.teaches), reduced(views.decides)
        draw = renderer(source, views.background, threads=threads)
        wanted = [draw(camera).rgb for camera in used]
        check = Judge.of_source(source, aside, views.background, threads=threads)
        return cls(used, wanted, check, views.background, threads)

    def taught(self, model: SplatModel, sh_degree: int, progress: Progress | None = None) -> SplatModel:
        """The scene with bands up to a degree, its colours such that it looks like the source as nearly as they can.

        Args:
            model: the geometry, and the colours to start from, of the source's degree or less.
            sh_degree: of the result, at most that of the model.
            progress: is told how much is done.

        Raises:
            InputError: the model has no such bands.
        """
        if sh_degree > model.sh_degree:
            raise InputError(f"SH of degree {model.sh_degree} cannot be brought to degree {sh_degree}")
        low = without_bands(model, sh_degree)
        found, _ = fit_colours(
            low, self.cameras, self.wanted, steps=_STEPS, least_gain=0.01, background=self.background,
            antialiased=low.antialiased, threads=self.threads, progress=progress,
        )  # fmt: skip
        return replace(low, sh0=np.ascontiguousarray(found[:, 0]), shN=np.ascontiguousarray(found[:, 1:]))
