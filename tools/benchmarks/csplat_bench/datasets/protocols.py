"""The four benchmark sets that papers report, how they are used, and what was published for them.

Figures of 3DGS: Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
ACM TOG 42(4), 2023: table 1 (means, sizes, 30,000 steps), the appendix's tables per scene, table 2 (NeRF-synthetic,
PSNR alone). Figures of c3dgs: Niedermayr, Stumpfegger, Westermann, "Compressed 3D Gaussian Splatting for Accelerated
Novel View Synthesis", CVPR 2024, means per set. Both measured LPIPS with the VGG backbone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import fmean

COLMAP, BLENDER, TRANSFORMS = "COLMAP", "Blender", "transforms.json"

#: Training steps of the published figures.
PAPER_STEPS = 30_000

#: The published code scales wider pictures down to this, pixels.
MAX_WIDTH = 1600

_INRIA_SPLAT_BYTES = 248  # in the published code's PLY: 62 floats


@dataclass(frozen=True)
class Published:
    """Figures printed in a paper; `None` if it does not print one.

    Attributes:
        psnr: mean over the test images, dB.
        ssim: mean over the test images.
        lpips_vgg: mean over the test images, VGG backbone.
        size_mb: size of the file in MB, as printed.
        train: training time, as printed.
    """

    psnr: float | None = None
    ssim: float | None = None
    lpips_vgg: float | None = None
    size_mb: float | None = None
    train: str | None = None


@dataclass(frozen=True)
class Protocol:
    """A benchmark set.

    Attributes:
        name: name in the papers.
        slug: for file names.
        kind: layout on disk, `COLMAP` or `BLENDER`.
        factors: scene → by how much its pictures are scaled down: 4 stands for the folder `images_4`.
    """

    name: str
    slug: str
    kind: str | None
    factors: dict[str, int] = field(default_factory=dict)


MIP_NERF_360 = Protocol(
    "Mip-NeRF 360",
    "mipnerf360",
    COLMAP,
    {
        **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), 4),
        **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), 2),
    },
)
TANKS_AND_TEMPLES = Protocol("Tanks and Temples", "tandt", COLMAP, dict.fromkeys(("train", "truck"), 1))
DEEP_BLENDING = Protocol("Deep Blending", "db", COLMAP, dict.fromkeys(("drjohnson", "playroom"), 1))
NERF_SYNTHETIC = Protocol(
    "NeRF-synthetic",
    "synthetic",
    BLENDER,
    dict.fromkeys(("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"), 1),
)

PROTOCOLS = (MIP_NERF_360, TANKS_AND_TEMPLES, DEEP_BLENDING, NERF_SYNTHETIC)

#: Sets of nobody's tables.
OTHER = Protocol("other sets", "other", None)

#: Per scene, after 30,000 steps.
THREE_DGS: dict[str, Published] = {
    "bicycle": Published(25.246, 0.771, 0.205),
    "flowers": Published(21.520, 0.605, 0.336),
    "garden": Published(27.410, 0.868, 0.103),
    "stump": Published(26.550, 0.775, 0.210),
    "treehill": Published(22.490, 0.638, 0.317),
    "room": Published(30.632, 0.914, 0.220),
    "counter": Published(28.700, 0.905, 0.204),
    "kitchen": Published(30.317, 0.922, 0.129),
    "bonsai": Published(31.980, 0.938, 0.205),
    "train": Published(21.097, 0.802, 0.218),
    "truck": Published(25.187, 0.879, 0.148),
    "drjohnson": Published(28.766, 0.899, 0.244),
    "playroom": Published(30.044, 0.906, 0.241),
    "chair": Published(35.83),
    "drums": Published(26.15),
    "ficus": Published(34.87),
    "hotdog": Published(37.72),
    "lego": Published(35.78),
    "materials": Published(30.00),
    "mic": Published(35.36),
    "ship": Published(30.80),
}

#: Size of the files and time of training, means over all scenes of a set (an A6000 GPU).
_THREE_DGS_MEANS = {
    "mipnerf360": (734.0, "41 min 33 s"),
    "tandt": (411.0, "26 min 54 s"),
    "db": (676.0, "36 min 2 s"),
}

#: Means over all scenes of a set.
C3DGS: dict[str, Published] = {
    "mipnerf360": Published(26.981, 0.801, 0.238, 28.80),
    "tandt": Published(23.324, 0.832, 0.194, 17.28),
    "db": Published(29.381, 0.898, 0.253, 25.30),
    "synthetic": Published(32.936, 0.967, 0.033, 3.68),
}


def published_means(protocol: Protocol, scenes: Sequence[str]) -> Published:
    """Means of 3DGS's figures over these scenes; size and time if they are all scenes of the set.

    Args:
        protocol: one of `PROTOCOLS`.
        scenes: some of its scenes, at least one.
    """
    rows = [THREE_DGS[scene] for scene in scenes]
    size_mb, train = None, None
    if set(scenes) == set(protocol.factors):
        size_mb, train = _THREE_DGS_MEANS.get(protocol.slug, (None, None))
    return Published(
        psnr=_mean([row.psnr for row in rows]),
        ssim=_mean([row.ssim for row in rows]),
        lpips_vgg=_mean([row.lpips_vgg for row in rows]),
        size_mb=size_mb,
        train=train,
    )


def published_splats(protocol: Protocol) -> int | None:
    """Splats of 3DGS, mean over a set, as the size of its files tells; `None` if no size is printed."""
    size_mb, _ = _THREE_DGS_MEANS.get(protocol.slug, (None, None))
    return None if size_mb is None else round(size_mb * 1e6 / _INRIA_SPLAT_BYTES)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None
