"""Encode a scene in one call, with the given options or to a target."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, Protocol, overload

from numpy.typing import NDArray

from csplat.disk_files import BinaryWriter, open_writer
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.encode_plan import EncodePlan, Origin
from csplat.encoder.error_targets import meet_bounds
from csplat.encoder.levels import LevelBuilder
from csplat.encoder.pipeline import EncodeResult, encode_tiles
from csplat.encoder.splat_importance import Importance
from csplat.encoder.target import Target, Views
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.plugins import load_plugins
from csplat.types import null_progress

#: Levels of detail: their number above the scene, "auto" for as many as it takes to reach 4,096 splats, or a builder.
Levels = int | Literal["auto"] | LevelBuilder | None
_Progress = Callable[[str, float], None]


class Search(Protocol):
    """Meets a target by rendering; an entry point of `csplat.search`."""

    def __call__(
        self,
        model: SplatModel,
        options: EncodeOptions,
        *,
        target: Target,
        views: Views | None,
        importance: NDArray[Any] | Importance | None,
        levels: LevelBuilder | None,
        progress: _Progress | None,
    ) -> EncodeResult:
        """Return the best file within the target; arguments as for `encode_with_report`."""
        ...


@overload
def encode(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    out: None = None,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    progress: _Progress | None = None,
) -> bytes: ...


@overload
def encode(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    out: str | os.PathLike[str] | BinaryWriter,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    progress: _Progress | None = None,
) -> None: ...


def encode(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    out: str | os.PathLike[str] | BinaryWriter | None = None,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    progress: _Progress | None = None,
) -> bytes | None:
    """Encode a scene.

    Args:
        model: the scene.
        options: default: the preset "balanced". With a target, options that are set are not changed by the search; the
            preset "fast" tries no codebooks and keeps all splats.
        out: a path, written atomically and replaced if it exists, or an open binary file; `None`: return the bytes.
        target: the target that a search meets; `None`: encode with the options as they are. All targets but largest
            errors alone require rendering, which takes minutes, and the packages of the extra `render`.
        views: a `csplat_tools.ViewSet` of training, validation and test views for the search; `None`: virtual ones
            around the scene.
        importance: see `EncodePlan.of`.
        levels: number of levels of detail above the scene, 1 to 16, "auto" or a builder; their bytes count for a
            target. Building them takes minutes per million splats, and the extra `render`. `None`: the file has none.
        progress: called with the stage and the fraction done, 0 to 1.

    Returns:
        The bytes of a `.csplat` file, `None` with `out`. They depend only on the arguments and the versions of the
        libraries and, with a target or a shape codebook, on the processor.

    Examples:
        >>> import csplat
        >>> from pathlib import Path
        >>> model = csplat.read("scene.ply")
        >>> data = csplat.encode(model, csplat.EncodeOptions(preset="fast"))
        >>> Path("small.csplat").write_bytes(data) == len(data)
        True
        >>> csplat.encode(model, out="small.csplat")
        >>> csplat.encode(model, out="small.csplat", target=csplat.Target(psnr=38), levels="auto")  # doctest: +SKIP

    Raises:
        InputError: `model` is not a model, a value fits no lattice, an option is not allowed for the model or is
            determined by the target, or the target is out of reach.
    """
    result = encode_with_report(
        model, options, target=target, views=views, importance=importance, levels=levels, progress=progress
    )
    if out is None:
        return result.data
    with open_writer(out) as stream:
        stream.write(result.data)
    return None


def encode_with_report(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    origin: Origin | None = None,
    metadata: Mapping[str, Any] | None = None,
    progress: _Progress | None = None,
) -> EncodeResult:
    """Encode a scene, and report choices and errors.

    Args:
        model, options, target, views, importance, levels, progress: see `encode`.
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
    check_model("the encoder", model)
    options = EncodeOptions() if options is None else options
    if not isinstance(options, EncodeOptions):
        raise InputError(f"options is {options!r}, expected csplat.EncodeOptions(preset=...)")
    builder = _builder_of(levels, len(model), options)
    if target is None:
        if views is not None:
            raise InputError("views are given without a target, expected both or neither")
        plan = EncodePlan.of(model, options, importance=importance, origin=origin, progress=progress)
        return _encode(plan, builder, metadata, progress)
    if not isinstance(target, Target):
        raise InputError(f"target is {target!r}, expected csplat.Target(psnr=...)")
    if origin is not None or metadata is not None:
        raise InputError("a target excludes origin and metadata")
    if target.is_rendered:
        search: Search = _plugin("csplat.search", "target", "search for targets")
        return search(
            model, options, target=target, views=views, importance=importance, levels=builder, progress=progress
        )
    bounded, options = meet_bounds(model, options, target, importance=importance, progress=progress)
    if builder is None or bounded.report.search is None:
        return bounded
    result = _encode(EncodePlan.of(model, options, importance=importance, progress=progress), builder, None, progress)
    return result.with_search(replace(bounded.report.search, size_bytes=result.size_bytes))


def _encode(
    plan: EncodePlan, levels: LevelBuilder | None, metadata: Mapping[str, Any] | None, progress: _Progress | None
) -> EncodeResult:
    if levels is None:
        return encode_tiles(plan, progress=progress).write(metadata)
    encoded = levels.encode_plan(plan, progress=progress or null_progress)
    return encoded.write({**(metadata or {}), "levels": levels.settings(len(plan.model))})


def _builder_of(levels: Levels, count: int, options: EncodeOptions) -> LevelBuilder | None:
    if levels is None or not isinstance(levels, int | str):
        return levels
    builder: LevelBuilder | None = _plugin("csplat.levels", "builder", "builder of levels of detail")(
        count, options, levels
    )
    return builder


def _plugin(group: str, name: str, what: str) -> Any:
    plugin = load_plugins(group).get(name)
    if plugin is None:
        raise InputError(f"no {what} is installed (entry points of {group}): pip install 'csplat[render]'")
    return plugin
