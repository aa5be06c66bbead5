"""`FinetuneOptions`, checked once; and the views of fine-tuning: images, or renders of the source."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.posed_images import PosedImage, compose
from csplat_trainer.training_options import LOSSES, Loss


@dataclass(frozen=True)
class FinetuneOptions:
    """Options of fine-tuning. Learning rates rise for `warm_up` steps, and fall to `decay` along half a cosine.

    Attributes:
        iterations: steps at most, one image each.
        seed: seed of the order of the images.
        loss: `inria`, `study` or `l1`, as in `TrainOptions`.
        lr_means: learning rate of the means, as a share of the median of the splats' middle standard deviation.
        lr_quats: learning rate of the rotations.
        lr_scales: learning rate of the log scales.
        lr_opacities: learning rate of the logits of opacity.
        lr_sh0: learning rate of the base colour.
        lr_shN: learning rate of the higher SH coefficients.
        lr_entries: learning rate of the codebook's entries.
        lr_exposure: as in `TrainOptions`; 0: gains and biases of images are not trained.
        byte_cost: rate weight: loss per bit and splat; 0: the size of the file has no influence.
        warm_up: steps in which Adam estimates the magnitude of gradients, and values hardly move.
        decay: fraction of the learning rates that remains at the end. It is tiny, because values that still move
            alternate between two integers.
        validate_every: steps between evaluations on the validation views.
        patience: evaluations without a gain after which a run ends early, once the learning rates have fallen to a
            quarter: before, values fluctuate too much. With a size target, evaluations at which the file is still too
            large do not count. 0: never.
        log_every: steps between entries of the log.

    Raises:
        InputError: a value is out of its range.
    """

    iterations: int = 1_000
    seed: int = 0
    loss: Loss = "inria"
    lr_means: float = 0.1
    lr_quats: float = 8e-3
    lr_scales: float = 2e-2
    lr_opacities: float = 0.1
    lr_sh0: float = 1e-2
    lr_shN: float = 2e-3
    lr_entries: float = 4e-3
    lr_exposure: float = 0.0
    byte_cost: float = 1e-4
    warm_up: int = 100
    decay: float = 5e-4
    validate_every: int = 100
    patience: int = 4
    log_every: int = 100

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise InputError(f"loss is {self.loss!r}, wanted one of {', '.join(LOSSES)}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name} is {value}, wanted {low:g} to {high:g}")

    def share(self, iteration: int) -> float:
        """Return the factor of the learning rates at a step."""
        done = (iteration - 1) / self.iterations
        rising = min(1.0, iteration / (self.warm_up + 1))
        return rising * (self.decay + (1.0 - self.decay) * 0.5 * (1.0 + math.cos(math.pi * done)))

    def has_calmed(self, iteration: int) -> bool:
        """Return True if evaluations without a gain count."""
        return iteration > 0.5 * self.iterations and self.share(iteration) <= _CALM

    def scaled(self, factor: float) -> FinetuneOptions:
        """Return the same options with all learning rates times a factor."""
        rates = {name: getattr(self, name) * factor for name in _RANGES if name.startswith("lr_")}
        return replace(self, **rates)


_CALM = 0.25  # factor of the learning rates from which evaluations without a gain count

_RANGES: dict[str, tuple[float, float]] = {
    "iterations": (1, 10**7),
    "seed": (0, 2**63 - 1),
    "lr_means": (0, 10),
    "lr_quats": (0, 1),
    "lr_scales": (0, 1),
    "lr_opacities": (0, 10),
    "lr_sh0": (0, 1),
    "lr_shN": (0, 1),
    "lr_entries": (0, 1),
    "lr_exposure": (0, 1),
    "byte_cost": (0, 1),
    "warm_up": (0, 10**7),
    "decay": (0, 1),
    "validate_every": (1, 10**7),
    "patience": (0, 10**6),
    "log_every": (1, 10**7),
}


_MAX_VALIDATION = 16  # largest number of validation views that are training views too
_FLOAT16_MAX = np.float32(6e4)  # largest value for float16


@dataclass(frozen=True, eq=False)
class TuningView:
    """A camera and its reference image.

    Attributes:
        camera: relative to the scene's origin.
        reference: the reference image: an image of a data set, or [H, W, 3] float16 or float32.

    Raises:
        InputError: the reference has another size than the camera's image.
    """

    camera: Camera
    reference: PosedImage | NDArray[np.floating[Any]]

    def __post_init__(self) -> None:
        shape = (self.camera.H, self.camera.W, 3)
        if not isinstance(self.reference, PosedImage) and self.reference.shape != shape:
            raise InputError(f"a wanted picture has shape {list(self.reference.shape)}, wanted {list(shape)}")

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Pixels that count, [H, W]; `None`: all of them."""
        return self.reference.mask if isinstance(self.reference, PosedImage) else None

    def image(self, background: F32, out: F32) -> F32:
        """Return the reference image, [H, W, 3] float32; `out` may be overwritten and returned."""
        if isinstance(self.reference, PosedImage):
            return compose(self.reference, background, out)
        np.copyto(out, self.reference)
        return out


@dataclass(frozen=True, eq=False)
class TuningViews:
    """Training views, validation views, and the colour behind all of them.

    Attributes:
        train: at least one.
        validation: at least one; they are among `train` unless they are held out.
        background: [3].

    Raises:
        InputError: one of the two is empty.
    """

    train: Sequence[TuningView]
    validation: Sequence[TuningView]
    background: F32

    def __post_init__(self) -> None:
        if not self.train or not self.validation:
            raise InputError("fine-tuning wants at least one view to learn from and one to decide by")

    @property
    def digest(self) -> str:
        """Hash of the training cameras, the split and the background, which identifies these views."""
        cameras = [(c.W, c.H, c.K.tolist(), c.viewmat.tolist()) for c in (one.camera for one in self.train)]
        identity = repr((cameras, len(self.validation), self.is_held_out, self.background.tolist()))
        return hashlib.sha256(identity.encode()).hexdigest()

    @property
    def is_held_out(self) -> bool:
        """True if no validation view is a training view."""
        return not any(one is other for one in self.validation for other in self.train)


def split_views(views: Sequence[TuningView], background: F32, validation_count: int = 0) -> TuningViews:
    """Split views into training and validation views.

    A scene fits the images that it was trained on better than others. If some of them are held out here, they score
    worse with every step, whatever is gained elsewhere; so by default all are training views, and some of them are
    validation views, too.

    Args:
        views: the views, in the order in which they were taken.
        background: [3], behind all of them.
        validation_count: number of validation views that are held out: images that the scene was not trained on, or
            renders of it. 0: none.

    Raises:
        InputError: `validation_count` leaves no training view.
    """
    if validation_count >= len(views):
        raise InputError(f"{validation_count} of {len(views)} views to decide by leave none to learn from")
    count = validation_count or min(len(views), _MAX_VALIDATION)
    validation = {(2 * number + 1) * len(views) // (2 * count) for number in range(count)}
    training = [view for number, view in enumerate(views) if not validation_count or number not in validation]
    return TuningViews(training, [views[number] for number in sorted(validation)], background)


def renders_of(source: SplatModel, cameras: Sequence[Camera], background: F32, threads: int | None) -> list[TuningView]:
    """Return renders of a scene as views: the reference for its file if there are no images.

    They are kept in float16, with a PSNR of at least 66 dB up to white; there are hundreds of them.
    """
    rasteriser = Rasteriser(gradients=False, threads=threads)
    views = []
    for camera in cameras:
        seen = rasteriser.forward(source, camera, background=background, antialiased=source.antialiased).rgb
        views.append(TuningView(camera, np.clip(seen, -_FLOAT16_MAX, _FLOAT16_MAX).astype(np.float16)))
    return views
