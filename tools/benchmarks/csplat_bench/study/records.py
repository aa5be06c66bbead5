"""Types of the stored results of the study's strategies on a scene, as in the JSON file."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict

from csplat_bench.common.report import Machine


class Scored(TypedDict):
    """Scores on some views: PSNR pooled, then means and deviations over views; `None` if not measured."""

    views: int
    psnr: float
    psnr_mean: float
    psnr_std: float
    ssim: float | None
    ssim_std: float | None
    lpips: float | None
    lpips_std: float | None


class How(TypedDict):
    """All that a line depends on; `tuned` if a file was."""

    name: str
    reduction: dict[str, Any]
    preset: str
    decoded: bool
    kmeans: dict[str, Any] | None
    tuned: NotRequired[bool]


class Measured(Scored):
    """A line of a table.

    Attributes:
        splats: number of splats kept.
        study_bytes: size by the published rule.
        csplat_bytes, file_psnr_mean, file_psnr_std: size of the .csplat file, and scores of what it decodes to.
        books: by attribute, the entries of each codebook and the share of the variance that it loses.
        strategy_seconds, encode_seconds, seconds: time of the strategy, of encoding, and in total.
    """

    how: How
    splats: int
    study_bytes: int
    csplat_bytes: int
    file_psnr_mean: float
    file_psnr_std: float
    books: dict[str, Any]
    strategy_seconds: float
    encode_seconds: float
    seconds: float


class Survivors(Scored):
    """Splats that survive a threshold of opacity, and their scores."""

    tau: float
    splats: int


class Facts(TypedDict):
    """Facts that tables show of a scene; `how`, `training_seconds` and `training` are `None` for a given scene."""

    splats: int
    sh_degree: int
    bytes: int
    judged_by: str
    how: str | None
    training_seconds: float | None
    training: dict[str, Any] | None


class Known(TypedDict, total=False):
    """All that is known of a scene."""

    settings: dict[str, Any]
    machine: Machine
    facts: Facts
    order: list[str]
    rows: dict[str, Measured]
    taus: dict[str, list[Survivors]]
    attributes: dict[str, dict[str, dict[str, int]]]


#: By name of the scene.
Results = dict[str, Known]
