# SPDX-License-Identifier: Apache-2.0
"""LPIPS v0.1 with AlexNet (Zhang et al. 2018), without PyTorch.

With F_l the features after AlexNet's convolution l, scaled to unit length per pixel, the distance is

    Σ_l mean over pixels of w_l · (F_l(a) − F_l(b))²,  w_l: learned weights of the channels.

The weights are not part of this package. `load_lpips` looks for them

1. in the given file, an .npz with the arrays `AlexNet_0/Conv_{0..4}/kernel` (height, width, in, out), `…/bias`, and
   `NetLinLayer_{0..4}/Conv_0/kernel`;
2. in the file named by the environment variable CSPLAT_LPIPS;
3. in the user's cache, `csplat/lpips_alex.npz` under XDG_CACHE_HOME (else `~/.cache`);
4. if PyTorch is installed, in torchvision's AlexNet in torch's cache, with the linear heads of an installed `lpips` or
   `torchmetrics` package. Nothing is downloaded.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.errors import InputError
from csplat.types import F32
from csplat_render.metric_kernels import convolve

#: Minimum width and height of an image, pixels: AlexNet's last layer would be empty for smaller images.
MIN_SIZE = 31

#: Environment variable with the path of the weights, used if no file is given.
ENVIRONMENT = "CSPLAT_LPIPS"

#: Mean and standard deviation of the network's input by channel, for images in −1 to 1.
SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
SCALE = np.array([0.458, 0.448, 0.450], np.float32)

_EPSILON = 1e-10  # added to the length of a pixel's features, as in the lpips package, so that 0 stays 0

# Kernel (height, width, in, out), stride, padding, max-pooling before the convolution.
_LAYERS = (
    ((11, 11, 3, 64), 4, 2, False),
    ((5, 5, 64, 192), 1, 2, True),
    ((3, 3, 192, 384), 1, 1, True),
    ((3, 3, 384, 256), 1, 1, False),
    ((3, 3, 256, 256), 1, 1, False),
)
_TORCH_INDEX = (0, 3, 6, 8, 10)  # indices of AlexNet's convolutions among torchvision's `features`


@dataclass(frozen=True, eq=False)
class Lpips:
    """The weights of the five layers; calling it with two images returns their distance.

    Attributes:
        kernels: [height, width, in, out] each, float32.
        biases: [out] each.
        heads: [out] each, the weights w_l.
        source: origin of the weights, for messages.
    """

    kernels: tuple[F32, ...]
    biases: tuple[F32, ...]
    heads: tuple[F32, ...]
    source: str

    def __post_init__(self) -> None:
        for i, (shape, *_) in enumerate(_LAYERS):
            for name, array, expected in (
                ("kernel", self.kernels[i], shape),
                ("bias", self.biases[i], shape[-1:]),
                ("head", self.heads[i], shape[-1:]),
            ):
                if array.shape != expected:
                    raise InputError(f"{self.source}: {name} {i} has shape {[*array.shape]}, expected {[*expected]}")
                if not np.isfinite(array).all():
                    raise InputError(f"{self.source}: {name} {i} contains values that are not finite")

    def __call__(self, reference: NDArray[Any], image: NDArray[Any]) -> float:
        """Return the perceptual distance of two images, 0 if they are equal.

        Args:
            reference, image: [H, W, 3] floating, clipped to [0, 1]; H and W at least `MIN_SIZE`.
        """
        if reference.shape != image.shape or reference.ndim != 3 or reference.shape[2] != 3:
            raise InputError(
                f"the images for LPIPS have shapes {[*reference.shape]} and {[*image.shape]}, expected [H, W, 3] twice"
            )
        if reference.dtype.kind != "f" or image.dtype.kind != "f":
            raise InputError(f"LPIPS of {reference.dtype} and {image.dtype}, expected floating values in 0 to 1")
        if min(reference.shape[:2]) < MIN_SIZE:
            raise InputError(f"LPIPS requires images of at least {MIN_SIZE}×{MIN_SIZE} pixels")
        distance = 0.0
        for a, b, head in zip(_features(reference, self), _features(image, self), self.heads, strict=True):
            squares = np.square(_normalise_channels(a) - _normalise_channels(b)).mean(axis=(0, 1))
            distance += float(np.sum(squares * head))  # no product of BLAS, the bits of which follow the processor
        return distance


def load_lpips(path: str | Path | None = None) -> Lpips:
    """Find and read the weights.

    Args:
        path: an .npz file; `None`: search the other places listed above.

    Raises:
        InputError: the file does not contain weights, or none are found.
    """
    if path is not None:
        return _read_weights(Path(path))
    if named := os.environ.get(ENVIRONMENT):
        return _read_weights(Path(named))
    # Path.home() raises if there is no home; this leaves the ~.
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "csplat", "lpips_alex.npz")  # noqa: PTH111
    if cache.is_file():
        return _read_weights(cache)
    weights = load_torch_lpips()
    if weights is None:
        raise InputError(
            f"no LPIPS weights: neither {cache} nor a file named by {ENVIRONMENT}, nor (with PyTorch) torchvision's "
            "AlexNet in torch's cache and an installed lpips package"
        )
    return weights


def save_lpips(path: str | Path, weights: Lpips) -> None:
    """Write weights as an .npz file, which `load_lpips` reads without PyTorch."""
    arrays: dict[str, Any] = {}
    for i in range(len(_LAYERS)):
        arrays[f"AlexNet_0/Conv_{i}/kernel"] = weights.kernels[i]
        arrays[f"AlexNet_0/Conv_{i}/bias"] = weights.biases[i]
        arrays[f"NetLinLayer_{i}/Conv_0/kernel"] = weights.heads[i][None, None, :, None]
    np.savez(path, **arrays)


def _read_weights(path: Path) -> Lpips:
    """Read the weights from an .npz file in the layout of `save_lpips`.

    Raises:
        InputError: the file cannot be read, or an array is missing, not of finite floats or of another shape.
    """
    layers = range(len(_LAYERS))
    try:
        file = read_archive(path, "a file of LPIPS weights (.npz)")
    except OSError as error:
        raise InputError(f"LPIPS weights {path}: {error.strerror or error}") from error
    names = ("AlexNet_0/Conv_{}/kernel", "AlexNet_0/Conv_{}/bias", "NetLinLayer_{}/Conv_0/kernel")
    groups = [[file[name.format(i)] for i in layers] for name in names]
    if any(array.dtype.kind != "f" for group in groups for array in group):
        file.refuse("its arrays do not contain floating-point numbers")
    with np.errstate(over="ignore"):  # values beyond float32 are refused as not finite
        kernels, biases, heads = (tuple(array.astype(np.float32) for array in group) for group in groups)
    return Lpips(kernels, biases, tuple(head.reshape(-1) for head in heads), str(path))


def load_torch_lpips(cache: Path | None = None, heads_path: Path | None = None) -> Lpips | None:
    """Read the weights from PyTorch's files; return `None` if a file, or torch, is not installed.

    Args:
        cache: torch's cache folder; `None`: its default.
        heads_path: file of the linear heads; `None`: the file of an installed `lpips` or `torchmetrics` package.

    Raises:
        InputError: a file lacks some of the weights.
    """
    heads_path = heads_path or _heads_path()
    if heads_path is None or importlib.util.find_spec("torch") is None:
        return None
    torch: Any = importlib.import_module("torch")  # takes two seconds
    backbones = sorted((Path(cache or torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth"))
    if not backbones:
        return None
    backbone = torch.load(backbones[-1], map_location="cpu", weights_only=True)
    heads = torch.load(heads_path, map_location="cpu", weights_only=True)
    try:
        return Lpips(
            # torch: out, in, height, width
            kernels=tuple(
                np.ascontiguousarray(backbone[f"features.{i}.weight"].numpy().transpose(2, 3, 1, 0))
                for i in _TORCH_INDEX
            ),
            biases=tuple(backbone[f"features.{i}.bias"].numpy() for i in _TORCH_INDEX),
            heads=tuple(heads[f"lin{i}.model.1.weight"].numpy().reshape(-1) for i in range(len(_LAYERS))),
            source=f"{backbones[-1]} and {heads_path}",
        )
    except KeyError as error:
        raise InputError(f"{backbones[-1]} and {heads_path} contain no LPIPS weights: {error.args[0]}") from error


def _heads_path() -> Path | None:
    """Return the path of the linear heads in an installed `lpips` or `torchmetrics`; `None` if there is none."""
    for package, inside in (
        ("lpips", "weights/v0.1/alex.pth"),
        ("torchmetrics", "functional/image/lpips_models/alex.pth"),
    ):
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None and (path := Path(spec.origin).parent / inside).is_file():
            return path
    return None


def _features(image: NDArray[Any], weights: Lpips) -> list[F32]:
    """Return the features after each of AlexNet's five convolutions and its ReLU.

    Args:
        image: [H, W, 3], clipped to 0..1.
        weights: the network.

    Returns:
        [h, w, channels] each.
    """
    x: F32 = (np.clip(image.astype(np.float32), 0.0, 1.0) * np.float32(2.0) - np.float32(1.0) - SHIFT) / SCALE
    features = []
    for (_, stride, padding, pooled), kernel, bias in zip(_LAYERS, weights.kernels, weights.biases, strict=True):
        x = np.maximum(convolve(_max_pool(x) if pooled else x, kernel, bias, stride, padding), np.float32(0.0))
        features.append(x)
    return features


def _normalise_channels(x: F32) -> NDArray[np.float64]:
    """Return features [h, w, channels] in float64, with each pixel's features scaled to length 1; 0 stays 0."""
    wide = x.astype(np.float64)
    result: NDArray[np.float64] = wide / (np.sqrt(np.sum(wide * wide, axis=2, keepdims=True)) + _EPSILON)
    return result


def _max_pool(x: F32) -> F32:
    """Return the maximum over 3×3 pixels of [h, w, channels], with a stride of 2."""
    result: F32 = sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max(axis=(3, 4))
    return result
