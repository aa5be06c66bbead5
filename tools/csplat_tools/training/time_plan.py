# SPDX-License-Identifier: Apache-2.0
"""Resolution, splats and steps of a training that ends in a given time: `csplat train --time`.

The clock is read once, before the training: a few timed steps give the time of a step by pixels and splats. The
settings that follow are ordinary options, which give the same file at any later time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from csplat.context import DEFAULT_CONTEXT, Context
from csplat_tools.views import DataOptions
from csplat_trainer.data import DataSet, load
from csplat_trainer.training_loop import time_step
from csplat_trainer.training_options import TrainOptions

#: Factor of the time of a step of a trained scene, next to one of as many initial splats, which overlap less.
TRAINED = 1.15
#: Time that pruning, codebooks and tuning of a file take, as a fraction of the time of its training.
_FILE = 0.25
_STEPS_FRACTION = 0.95  # fraction of the time for steps; the rest reads images, times steps, scores and writes

_SPLATS = (20_000, 150_000)  # numbers of splats at which steps are timed
_PIXELS = (1 << 16, 1 << 20)  # largest numbers of pixels at which steps are timed
_SCALES = (1.0, 0.5, 0.25, 0.125)  # candidates for the size of images, as factors of width and height
_LEAST_SIDE = 100  # pixels of images that are scaled down, at least
_DIGITS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # leading digits of candidates for the number of splats
_MOST_SPLATS = 2_000_000
_LEAST_STEPS, _MOST_STEPS = 100, 30_000  # INRIA's trainings have 30,000 steps
_ASPECT = 0.02  # largest relative difference of aspect ratios of images that are scaled to one size

_PIXELS_PER_SPLAT = 200  # pixels of all unscaled training images for which there is a splat, at most
_DENSEST = 0.5  # splats per pixel of a scaled image, at most; smaller details are not in the images
# Fits to trainings on a CPU: fox with 10,000 splats in 2,000 and 6,000 steps (22.9, 25.3 dB) and with 60,000 (30.2 dB),
# Lego at 200×200 with 1,000 to 20,000 splats, and at 800×800 (`csplat_bench run photographs`). In ten minutes, images
# of half the width and height gave 0.4 dB more on fox and 4 dB less on desk29, whose details they lose.
_STEPS_LOSS = 8_000.0  # dB, divided by the number of steps
_SPLATS_LOSS = 1.9  # dB at the largest number of splats; grows with the root of how many times fewer there are
_PIXELS_LOSS = 1.0  # dB for each halving of the pixels


@dataclass(frozen=True)
class StepCost:
    """Time of a training step: a + b · pixels + c · splats + d · pixels · splats, seconds.

    Attributes:
        base, per_pixel, per_splat, per_both: a, b, c, d, at least 0.
    """

    base: float
    per_pixel: float
    per_splat: float
    per_both: float = 0.0

    @classmethod
    def of(cls, times: Mapping[tuple[int, int], float]) -> StepCost:
        """Return the cost from the times of four steps, seconds by (pixels, splats): few and many of either."""
        (low, few), (high, many) = min(times), max(times)
        by_few, by_many = ((times[high, n] - times[low, n]) / max(1, high - low) for n in (few, many))
        both = max(0.0, (by_many - by_few) / (many - few))
        per_pixel = max(0.0, by_few - both * few)
        per_splat = max(0.0, (times[low, many] - times[low, few]) / (many - few) - both * low)
        base = max(0.0, times[low, few] - per_pixel * low - per_splat * few - both * low * few)
        return cls(base, per_pixel, per_splat, both)

    def seconds(self, pixels: float, splats: float) -> float:
        """Return the time of a step with an image and a number of splats."""
        return self.base + self.per_pixel * pixels + (self.per_splat + self.per_both * pixels) * splats


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training that depend on its time.

    Attributes:
        size: width and height that images are scaled to; `None`: unscaled.
        max_splats, iterations: as in `TrainOptions`.
        seconds: expected time of the whole run; 0: unknown.
        scaled_from: width and height of the images, if the time was too short for them; otherwise `None`.
    """

    size: tuple[int, int] | None
    max_splats: int
    iterations: int
    seconds: float = 0.0
    scaled_from: tuple[int, int] | None = None


def plan_in_time(
    data: DataOptions,
    options: TrainOptions,
    seconds: float,
    *,
    to_file: bool,
    max_splats: int | None = None,
    most_splats: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> TrainingSettings:
    """Choose the settings of a training by timing a few steps, which takes seconds of the time.

    Args:
        data: the data set; its size, if it has one, is not changed.
        options: the other options.
        seconds: time of the whole run.
        to_file: True if a file is tuned after the training.
        max_splats: number of splats; `None`: it is chosen.
        most_splats: largest number to choose; `None`: no limit but that of the images.
        context: threads.

    Raises:
        InputError: the data set is invalid.
    """

    def opened(size: tuple[int, int] | None) -> DataSet:
        every = 8 if data.test_every is None else data.test_every
        return load(data.path, size, images=data.images, test_every=every, near=data.near, trust_paths=data.trust_paths)

    begin, whole = time.monotonic(), opened(data.size)
    sizes = [data.size] if data.size is not None else candidate_sizes(_sizes_of(whole))
    width, height = _sizes_of(whole)[0]
    times: dict[tuple[int, int], float] = {}
    for limit in _PIXELS:
        scale = min(1.0, math.sqrt(limit / (width * height)))
        if limit == _PIXELS[0]:
            scale = min(scale, 0.25)  # of small images, too
        size = max(1, round(scale * width)), max(1, round(scale * height))
        images = opened(size)
        for count in _SPLATS:
            context.progress("timing steps", len(times) / 4)
            times[size[0] * size[1], count] = time_step(images, options, count, context=context)
    context.progress("timing steps", 1.0)
    left = max(0.5 * seconds, seconds - (time.monotonic() - begin))
    return choose_settings(
        StepCost.of(times), left, sizes, (width, height), len(whole.train), to_file=to_file, max_splats=max_splats,
        most_splats=most_splats,
    )  # fmt: skip


def candidate_sizes(sizes: Sequence[tuple[int, int]]) -> list[tuple[int, int] | None]:
    """Return the sizes to which all images can be scaled, `None` for unscaled, which is the first.

    Args:
        sizes: width and height of each image. Images of several aspect ratios are not scaled, since that would distort
            them.
    """
    width, height = sizes[0]
    scaled: list[tuple[int, int] | None] = [None]
    if all(abs(w * height / (h * width) - 1.0) <= _ASPECT for w, h in sizes):
        scaled += [
            (round(scale * width), round(scale * height))
            for scale in _SCALES[1:]
            if scale * min(width, height) >= _LEAST_SIDE
        ]
    return scaled


def choose_settings(
    cost: StepCost,
    seconds: float,
    sizes: Sequence[tuple[int, int] | None],
    unscaled: tuple[int, int],
    image_count: int,
    *,
    to_file: bool,
    max_splats: int | None = None,
    most_splats: int | None = None,
) -> TrainingSettings:
    """Return the settings of the best expected quality that fit in a time.

    Args:
        cost: time of a step.
        seconds: time of the whole run. If it is too short for `_LEAST_STEPS`, the run takes longer.
        sizes: candidates, see `candidate_sizes`.
        unscaled: width and height of unscaled images.
        image_count: number of training images.
        to_file, max_splats, most_splats: as for `plan_in_time`.
    """
    all_pixels = unscaled[0] * unscaled[1]
    suitable = min(_MOST_SPLATS, image_count * all_pixels / _PIXELS_PER_SPLAT)
    best, least_loss = None, math.inf
    for size in sizes:
        width, height = size or unscaled
        limit = min(suitable, _DENSEST * width * height, most_splats or math.inf)
        for count in _splat_counts(limit) if max_splats is None else [max_splats]:
            per_step = TRAINED * cost.seconds(width * height, count) * (1.0 + _FILE * to_file)
            steps = _rounded(min(_MOST_STEPS, max(_LEAST_STEPS, _STEPS_FRACTION * seconds / per_step)))
            expected = steps * per_step + (1.0 - _STEPS_FRACTION) * min(seconds, steps * per_step)
            loss = expected_loss(width * height / all_pixels, count / suitable, steps)
            if steps == _LEAST_STEPS:  # the time may be too short: the fastest is the best
                loss = 100.0 + expected
            if loss < least_loss:
                scaled_from = None if size is None or size == unscaled else unscaled
                best, least_loss = TrainingSettings(size, count, steps, expected, scaled_from), loss
    assert best is not None
    return best


def expected_loss(pixels: float, splats: float, steps: float) -> float:
    """Return by how much settings are worse than the best ones, dB on unscaled held-out images; a rough estimate.

    Args:
        pixels: pixels of an image, as a fraction of those of the unscaled image.
        splats: number of splats, as a fraction of the largest number that suits the images.
        steps: number of steps.
    """
    return _STEPS_LOSS / steps + _SPLATS_LOSS / math.sqrt(splats) - _PIXELS_LOSS * math.log2(pixels)


def _splat_counts(limit: float) -> list[int]:
    """Return the candidates for the number of splats up to a limit, ascending; the limit alone if that is small."""
    counts = [round(digit * 10**power) for power in range(3, 7) for digit in _DIGITS]
    return [count for count in counts if count <= limit] or [max(1, int(limit))]


def _rounded(steps: float) -> int:
    """Return a number of steps rounded down to two digits."""
    unit = 10 ** max(0, math.floor(math.log10(steps)) - 1)
    return int(steps // unit * unit)


def _sizes_of(data: DataSet) -> list[tuple[int, int]]:
    """Return width and height of each image, the largest first."""
    sizes = [(image.camera.W, image.camera.H) for image in (*data.train, *data.test, *data.val)]
    return sorted(sizes, key=lambda size: size[0] * size[1], reverse=True)


def expected_seconds(data: DataSet, options: TrainOptions, done: int = 0, context: Context = DEFAULT_CONTEXT) -> float:
    """Return the expected time of a training's steps, from a few timed ones.

    Args:
        data: the data set; only a few images are read.
        options: options of the training.
        done: steps that a checkpoint has already.
        context: threads.
    """
    steps = max(0, options.iterations - done)
    return TRAINED * steps * time_step(data, options, options.max_splats, context=context)
