"""What a scene was trained on, as far as later pictures of it depend on that (spec 5.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["TRAINING", "TrainedOn"]

#: The key of the metadata under which it stands.
TRAINING = "training"


@dataclass(frozen=True)
class TrainedOn:
    """What whoever compares a scene with its photographs has to do as its training did.

    Attributes:
        background: red, green, blue behind the splats, 0..1.
        test_every: every so-manieth photograph was held out, 0 for none; `None`: the set names those itself.
        size: width and height that the photographs were scaled to, pixels; `None`: they were not.
        near: near plane of the cameras, scene units; `None`: not known.
        images: COLMAP sets: the folder of pictures; `None`: the reader chose.
    """

    background: tuple[float, float, float]
    test_every: int | None = None
    size: tuple[int, int] | None = None
    near: float | None = None
    images: str | None = None

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> TrainedOn | None:
        """What a scene's metadata says; `None` where it says nothing that can be understood."""
        said = metadata.get(TRAINING)
        if not isinstance(said, Mapping):
            return None
        background = _numbers(said.get("background"), 3)
        if background is None or not all(0.0 <= value <= 1.0 for value in background):
            return None
        size, near, every, images = (said.get(name) for name in ("size", "near", "test_every", "images"))
        pixels, plane = _numbers(size, 2), _numbers([near], 1)
        red, green, blue = background
        return cls(
            background=(red, green, blue),
            test_every=every if isinstance(every, int) and not isinstance(every, bool) and every >= 0 else None,
            size=(int(pixels[0]), int(pixels[1])) if pixels is not None and min(pixels) >= 1.0 else None,
            near=plane[0] if plane is not None and plane[0] > 0.0 else None,
            images=images if isinstance(images, str) else None,
        )

    def as_json(self) -> dict[str, Any]:
        """What goes into the metadata, without what is not known."""
        said: dict[str, Any] = {"background": list(self.background)}
        for name in ("test_every", "near", "images"):
            if getattr(self, name) is not None:
                said[name] = getattr(self, name)
        return said if self.size is None else {**said, "size": list(self.size)}


def _numbers(values: object, count: int) -> list[float] | None:
    """So many finite numbers, or `None`."""
    if not isinstance(values, list | tuple) or len(values) != count:
        return None
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return None
    numbers = [float(value) for value in values]
    return numbers if all(math.isfinite(number) for number in numbers) else None
