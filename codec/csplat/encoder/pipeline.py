"""From a model to the bytes of a file in one go."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from csplat.encoder.coded import EncodeResult
from csplat.encoder.draft import Draft, Origin
from csplat.encoder.importance import Importance
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Progress
from csplat.model import SplatModel

__all__ = ["encode", "encode_with_report"]


def encode(model: SplatModel, options: EncodeOptions | None = None) -> bytes:
    """Compress a scene.

    Args:
        model: the scene.
        options: presets and knobs; the default preset is "balanced".

    Returns:
        The bytes of a `.csplat` file. Same model, options and library versions: same bytes, at any thread count.

    Raises:
        InputError: values that no lattice can hold, or an option that the model does not allow.
    """
    return encode_with_report(model, options).data


def encode_with_report(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    importance: NDArray[Any] | Importance | None = None,
    origin: Origin | None = None,
    said: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Compress a scene and say how.

    Args:
        model, options, importance, origin, progress: as of `Draft.of`.
        said: as of `Coded.write`.

    Raises:
        InputError: as `encode`; or an importance of another shape, or negative, or not finite.
    """
    draft = Draft.of(model, options, importance=importance, origin=origin, progress=progress)
    return draft.coded(progress).write(said)
