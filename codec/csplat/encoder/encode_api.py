"""Encode a scene in one call, with the given options or to a target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import NDArray

from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.encode_plan import EncodePlan, Origin
from csplat.encoder.error_targets import meet_bounds
from csplat.encoder.pipeline import EncodeResult, encode_tiles
from csplat.encoder.splat_importance import Importance
from csplat.encoder.target import Target
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.plugins import load_plugins


def encode(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    target: Target | None = None,
    views: Any = None,
    progress: Callable[[str, float], None] | None = None,
) -> bytes:
    """Encode a scene.

    Args:
        model: the scene.
        options: default: the preset "balanced". With a target, options that are set are not changed by the search; the
            preset "fast" tries no codebooks and keeps all splats.
        target: the target that a search meets; `None`: encode with the options as they are. All targets but largest
            errors alone require rendering, which takes minutes, and the packages of the extra `render`.
        views: a `csplat_tools.ViewSet` of training, validation and test views for the search; `None`: virtual ones
            around the scene.
        progress: called with the stage and the fraction done, 0 to 1.

    Returns:
        The bytes of a `.csplat` file. They depend only on the model, options, target, views and the versions of the
        libraries and, with a target or a shape codebook, on the processor.

    Examples:
        >>> import csplat
        >>> from pathlib import Path
        >>> model = csplat.read("scene.ply")
        >>> data = csplat.encode(model, csplat.EncodeOptions(preset="fast"))
        >>> Path("small.csplat").write_bytes(data) == len(data)
        True
        >>> data = csplat.encode(model, target=csplat.Target(psnr=38))  # doctest: +SKIP

    Raises:
        InputError: `model` is not a model, a value fits no lattice, an option is not allowed for the model or is
            determined by the target, or the target is out of reach.
    """
    return encode_with_report(model, options, target=target, views=views, progress=progress).data


def encode_with_report(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    target: Target | None = None,
    views: Any = None,
    importance: NDArray[Any] | Importance | None = None,
    origin: Origin | None = None,
    metadata: Mapping[str, Any] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> EncodeResult:
    """Encode a scene, and report choices and errors.

    Args:
        model, options, target, views, progress: see `encode`.
        importance: see `EncodePlan.of`.
        origin: see `EncodePlan.of`; not with a target.
        metadata: see `EncodedTiles.write`; not with a target.

    Examples:
        >>> import csplat
        >>> model = csplat.read("scene.ply")
        >>> largest, rms = csplat.encode_with_report(model).report.errors["opacities"]  # declared by the file
        >>> 0.0 < rms < largest < 0.1
        True
        >>> result = csplat.encode_with_report(model, target=csplat.Target(max_error={"means": 0.001}))
        >>> result.report.search.reached["means"] <= 0.001
        True
        >>> result.save("bounded.csplat")

    Raises:
        InputError: as in `encode` and `EncodePlan.of`; or the target requires the extra `render`.
        OSError: an image of the views cannot be read.
    """
    if target is None:
        if views is not None:
            raise InputError("views are given without a target, expected both or neither")
        plan = EncodePlan.of(model, options, importance=importance, origin=origin, progress=progress)
        return encode_tiles(plan, progress=progress).write(metadata)
    check_model("the encoder", model)
    if not isinstance(target, Target):
        raise InputError(f"target is {target!r}, expected csplat.Target(psnr=...)")
    options = EncodeOptions() if options is None else options
    if not isinstance(options, EncodeOptions):
        raise InputError(f"options is {options!r}, expected csplat.EncodeOptions(preset=...)")
    if origin is not None or metadata is not None:
        raise InputError("a target excludes origin and metadata")
    if not target.is_rendered:
        return meet_bounds(model, options, target, importance=importance, progress=progress)[0]
    search = load_plugins("csplat.search").get("target")
    if search is None:
        raise InputError(
            "no search for targets is installed (entry points of csplat.search): pip install 'csplat[render]'"
        )
    found: EncodeResult = search(model, options, target=target, views=views, importance=importance, progress=progress)
    return found
