"""Rules by which other engines draw splats, and our pictures by the same: what still differs is due to the file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat_render import Camera, render
from csplat_render.kernels import python_function
from csplat_render.projection import sh_basis

Picture = NDArray[np.float32]

DEGREE = 3


@dataclass(frozen=True)
class Engine:
    """A program that draws splats.

    Attributes:
        title: the usual spelling.
        reads: formats, as `csplat formats` names them.
        clips: whether it cuts the colour of a splat to 0..1, also that of degree 0 before it adds the others.
        thin: whether it widens splats by half as much as we do.
        antialiased: whether it takes off opacity what the dilation adds, whatever a file says.
    """

    title: str
    reads: tuple[str, ...]
    clips: bool = False
    thin: bool = False
    antialiased: bool = False

    def drawn(self, model: SplatModel, camera: Camera, sh_degree: int) -> Picture:
        """Our picture by these rules."""
        shown = _coloured(model, camera, min(sh_degree, model.sh_degree)) if self.clips else model
        if self.thin:  # twice as large, and every other pixel, with centres where they were
            K = 2.0 * camera.K
            K[2] = 0.0, 0.0, 1.0
            K[:2, 2] -= 0.5
            camera = replace(camera, K=K, W=2 * camera.W, H=2 * camera.H)
        step = 2 if self.thin else 1
        return drawn(shown, camera, antialiased=self.antialiased or None, sh_degree=sh_degree)[::step, ::step]


#: By the names of their pages.
ENGINES = {
    "three": Engine("three.js", ("ply", "csplat", "gltf", "spz", "spz4", "splat"), clips=True, antialiased=True),
    "playcanvas": Engine("PlayCanvas", ("ply", "csplat", "gltf", "sog", "compressed-ply", "spz4"), thin=True),
    "babylon": Engine(
        "Babylon.js", ("ply", "csplat", "gltf", "sog", "compressed-ply", "spz", "spz4", "splat"), clips=True, thin=True
    ),
    "spark": Engine("Spark", ("ply", "csplat")),
}


def drawn(model: SplatModel, camera: Camera, *, antialiased: bool | None = None, sh_degree: int = DEGREE) -> Picture:
    """Our picture, as a screen shows it."""
    return np.clip(render(model, camera, antialiased=antialiased, sh_degree=sh_degree).rgb, 0.0, 1.0)


def _coloured(model: SplatModel, camera: Camera, degree: int) -> SplatModel:
    """The splats in the colours that they have from somewhere, cut to 0..1, without SH."""
    directions = model.means - camera.position
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = np.empty(((degree + 1) ** 2, len(model)))
    x, y, z = directions.T
    python_function(sh_basis)(degree, x, y, z, basis)
    colours = np.clip(0.5 + basis[0, 0] * model.sh0, 0.0, 1.0)
    colours += np.einsum("kn,nkc->nc", basis[1:], model.shN[:, : len(basis) - 1])
    sh0 = (np.clip(colours, 0.0, 1.0) - 0.5) / basis[0, 0]
    return replace(model, sh0=sh0.astype(np.float32), shN=model.shN[:, :0])
