"""Types of the stored results of a benchmark scene, as in the JSON file."""

from __future__ import annotations

from typing import Any, TypedDict


class File(TypedDict):
    """The PLY, or a compressed file of it; scores are those of what it decodes to, on the held-out pictures."""

    file: str
    size_bytes: int
    encode_seconds: float | None
    psnr_mean: float
    ssim: float | None
    lpips: float | None


class Record(TypedDict, total=False):
    """A scene.

    Attributes:
        key: names its files. title, scene, set, kind: see `SceneFolder`.
        images, size, protocol_size, remarks: see `PictureChoice`.
        settings: options of its training, and what that took; `None` if it was trained elsewhere.
        test_views, pixels, background, splats, sh_degree, files: the images and files that were scored.
        scoring: whatever the scores depend on.
    """

    key: str
    title: str
    scene: str
    set: str
    kind: str
    images: str | None
    size: tuple[int, int] | None
    protocol_size: tuple[int, int]
    remarks: list[str]
    settings: dict[str, Any] | None
    train_views: int
    train_seconds: float | None
    test_views: int
    pixels: tuple[int, int]
    background: tuple[float, float, float]
    splats: int
    sh_degree: int
    files: list[File]
    scoring: dict[str, Any]
