"""Published figures of other methods: files made from the same photographs of a scene."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """A file as it was published.

    Attributes:
        method: name that its authors use.
        psnr: mean over the test views, dB.
        size_bytes: size of the file.
        ssim, lpips: means; `None` if they were not given. LPIPS is VGG's: not to be compared with AlexNet's.
        network: whether a decoder has to evaluate neural networks.
        source: where the figures are published.
    """

    method: str
    psnr: float
    size_bytes: int
    ssim: float | None
    lpips: float | None
    network: bool
    source: str


_CSV = "results/SyntheticNeRF/lego.csv"
_HAC = f"github.com/YihangChen-ee/HAC, {_CSV}"
_HAC_PLUS = f"github.com/YihangChen-ee/HAC-plus, {_CSV}"
_SOG = f"github.com/fraunhoferhhi/Self-Organizing-Gaussians, {_CSV}"
_MESON = f"github.com/ShuzhaoXie/MesonGS, {_CSV}"
_SURVEY = "github.com/w-m/3dgs-compression-survey, sources/results_liu2024hemgs/SyntheticNeRF/lego.csv"
_RDO = "Wang et al., ECCV 2024"
_COMPACT = "Lee et al., CVPR 2024"

#: By scene, as configuration files are called.
PUBLISHED = {
    "lego800": (
        Published("HAC", 35.669, 1_997_013, 0.9811, 0.0185, True, _HAC),
        Published("HAC", 35.505, 1_685_796, 0.9806, 0.0191, True, _HAC),
        Published("HAC", 35.038, 1_313_656, 0.9790, 0.0218, True, _HAC),
        Published("HAC", 34.648, 1_123_759, 0.9772, 0.0244, True, _HAC),
        Published("HAC", 34.249, 1_019_006, 0.9756, 0.0268, True, _HAC),
        Published("HAC++", 35.772, 1_916_902, 0.9815, 0.0178, True, _HAC_PLUS),
        Published("HAC++", 34.328, 843_579, 0.9756, 0.0275, True, _HAC_PLUS),
        Published("HEMGS", 35.745, 1_865_941, 0.9812, 0.0186, True, _SURVEY),
        Published("HEMGS", 35.306, 1_417_884, 0.9795, 0.0213, True, _SURVEY),
        Published("RDO-Gaussian", 35.25, 2_770_000, None, None, False, _RDO),
        Published("RDO-Gaussian", 35.12, 2_230_000, None, None, False, _RDO),
        Published("RDO-Gaussian", 34.70, 1_590_000, None, None, False, _RDO),
        Published("RDO-Gaussian", 34.04, 1_220_000, None, None, False, _RDO),
        Published("Compact-3DGS", 34.96, 3_180_000, None, None, True, _COMPACT),
        Published("Self-Organizing Gaussians", 34.959, 4_521_377, 0.9771, 0.0206, False, _SOG),
        Published("Self-Organizing Gaussians, SH 0", 34.038, 2_043_294, 0.9760, 0.0218, False, _SOG),
        Published("MesonGS", 35.056, 4_697_206, 0.9801, 0.0187, False, _MESON),
        Published("MesonGS", 35.048, 4_253_192, 0.9801, 0.0187, False, _MESON),
    ),
}
