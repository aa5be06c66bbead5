"""From a model to the bytes of a file in one go."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import NDArray

from csplat.encoder.coded import EncodeResult
from csplat.encoder.draft import Draft, Origin
from csplat.encoder.importance import Importance
from csplat.encoder.options import EncodeOptions
from csplat.model import SplatModel


def encode(
    model: SplatModel, options: EncodeOptions | None = None, *, progress: Callable[[str, float], None] | None = None
) -> bytes:
    """Compress a scene.

    Args:
        model: the scene.
        options: presets and knobs; the default preset is "balanced".
        progress: is told the stage and the share of it that is done, 0 to 1.

    Returns:
        The bytes of a `.csplat` file. Same model, options and library versions: same bytes, at any thread count.

    Examples:
        >>> import csplat
        >>> from pathlib import Path
        >>> data = csplat.encode(csplat.read_ply("scene.ply"), csplat.EncodeOptions(preset="fast"))
        >>> Path("small.csplat").write_bytes(data) == len(data)
        True

    Raises:
        InputError: values that no lattice can hold, or an option that the model does not allow; or it is no model.
    """
    return encode_with_report(model, options, progress=progress).data


def encode_with_report(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    importance: NDArray[Any] | Importance | None = None,
    origin: Origin | None = None,
    said: Mapping[str, Any] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> EncodeResult:
    """Compress a scene and say how: what `csplat encode` calls where no target is given.

    Args:
        model, options, importance, origin, progress: as of `Draft.of`.
        said: as of `Coded.write`.

    Examples:
        >>> import csplat
        >>> result = csplat.encode_with_report(csplat.read_ply("scene.ply"))
        >>> most, rms = result.report.errors["opacities"]  # of any splat, and over all, as the file states them
        >>> 0.0 < rms < most < 0.1
        True

    Raises:
        InputError: as `encode`; or an importance of another shape, or negative, or not finite.
    """
    draft = Draft.of(model, options, importance=importance, origin=origin, progress=progress)
    return draft.coded(progress).write(said)
