"""Types of the stored results of compressing a scene, as in the JSON file."""

from __future__ import annotations

from typing import Any, TypedDict

from csplat_bench.common.captures import Training
from csplat_bench.common.report import Machine


class Scores(TypedDict):
    """On held-out photographs: PSNR pooled, and the mean of theirs, dB; LPIPS by AlexNet, if it was wanted."""

    psnr: float
    psnr_mean: float
    ssim: float
    lpips: float | None


class Facts(TypedDict):
    """Facts that tables show of the scene itself."""

    splats: int
    sh_degree: int
    train_views: int
    test_views: int
    scores: Scores
    training: Training


class Row(TypedDict):
    """A file, before and after tuning.

    Attributes:
        splats: number of splats kept.
        sh_entries, shapes: entries of the codebooks; 0 if there are none.
        sh_escapes, shape_escapes: share of the splats that have values of their own.
        attribute_bytes: size of each attribute in the tuned file.
        seconds: by stage.
        encoding: options of the encoder.
    """

    splats: int
    before_bytes: int
    after_bytes: int
    before: Scores
    after: Scores
    sh_entries: int
    sh_escapes: float | None
    shapes: int
    shape_escapes: float | None
    attribute_bytes: dict[str, int]
    steps: int
    best_step: int
    seconds: dict[str, float]
    encoding: dict[str, Any]


class Step(Scores):
    """A step of the pipeline and what it leaves: a PLY, floats or integers in memory, or a decoded file."""

    row: str
    stored: str
    size_bytes: int
    seconds: float


class Control(TypedDict):
    """As many steps on values that no quantiser touches; the size is that of a file of them that was not tuned."""

    steps: int
    best_step: int
    seconds: float
    splats: int
    size_bytes: int
    scores: dict[str, Scores]


class Memory(TypedDict):
    """Largest resident size of `csplat finetune`, and that before; and what the command reports."""

    before_bytes: int
    peak_bytes: int
    report: dict[str, Any]


class Known(TypedDict, total=False):
    """All results of a scene, by kind and name."""

    settings: dict[str, Any]
    machine: Machine
    facts: dict[str, Facts]
    ablation: dict[str, list[Step]]
    main: dict[str, Row]
    control: dict[str, Control]
    others: dict[str, Row]
    sizes: dict[str, Row]
    escapes: dict[str, Row]
    positions: dict[str, Row]
    curve: dict[str, Row]
    memory: dict[str, Memory]
