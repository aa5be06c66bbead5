"""Distil SH to a lower degree: the colours of fewer bands are refitted to renders of the source.

With fixed geometry a render is linear in the coefficients, so the fit is a ridge least-squares problem that conjugate
gradients solve (`csplat_render.refit`); nothing is trained. Few views overfit, far more than for the choice of splats:
300 splats with extreme SH lost 0.7 dB on other views if degree 0 was fitted to 28 views, and gained 2.3 with 112.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_source import drop_bands
from csplat.types import F32, Progress
from csplat_render import Camera
from csplat_render.refit import fit_colours
from csplat_render.scorer import Scorer, renderer
from csplat_tools.views import ViewSet, shrink_cameras

_STEPS = 8  # largest number of conjugate gradient steps; more overfit the training views


@dataclass(frozen=True, eq=False)
class SourceRenders:
    """Renders of a source, to which the colours of other scenes are fitted.

    Attributes:
        cameras: the views.
        references: [H, W, 3], the source's render of each.
        check_scorer: scorer by views that nothing is fitted to.
        background: red, green, blue behind everything.
        threads: number of threads; None for all. No result depends on it.
    """

    cameras: Sequence[Camera]
    references: Sequence[F32]
    check_scorer: Scorer
    background: tuple[float, float, float]
    threads: int | None

    @classmethod
    def of_source(
        cls,
        source: SplatModel,
        views: ViewSet,
        *,
        threads: int | None = None,
    ) -> SourceRenders:
        """Render a source.

        Args:
            source: the scene.
            views: colours are fitted to training views, and checked on validation views. Large views are reduced.
            threads: number of threads.

        Raises:
            InputError: there are no training or no validation views.
        """
        if not views.training:
            raise InputError("no view is left to learn colours from")
        used, aside = shrink_cameras(views.training), shrink_cameras(views.validation)
        draw = renderer(source, views.background, threads=threads)
        references = [draw(camera).rgb for camera in used]
        check_scorer = Scorer.of_source(source, aside, views.background, threads=threads)
        return cls(used, references, check_scorer, views.background, threads)

    def distilled(self, model: SplatModel, sh_degree: int, progress: Progress | None = None) -> SplatModel:
        """Return the scene with SH up to a degree, with colours fitted to the source's renders.

        Args:
            model: the geometry, and the colours to start from, of the source's degree or less.
            sh_degree: SH degree of the result, at most that of the model.
            progress: progress callback.

        Raises:
            InputError: the model has no such bands.
        """
        if sh_degree > model.sh_degree:
            raise InputError(f"SH of degree {model.sh_degree} cannot be brought to degree {sh_degree}")
        low = drop_bands(model, sh_degree)
        found, _ = fit_colours(
            low, self.cameras, self.references, steps=_STEPS, least_gain=0.01, background=self.background,
            antialiased=low.antialiased, threads=self.threads, progress=progress,
        )  # fmt: skip
        return replace(low, sh0=np.ascontiguousarray(found[:, 0]), shN=np.ascontiguousarray(found[:, 1:]))
