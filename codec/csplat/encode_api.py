# SPDX-License-Identifier: Apache-2.0
"""Encode a scene in one call: of any size, with the given options or to a target, with or without levels of detail."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, Protocol, overload

from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import BinaryWriter, open_writer
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.encode_plan import EncodePlan
from csplat.encoder.error_targets import meet_bounds
from csplat.encoder.levels import LevelBuilder
from csplat.encoder.pipeline import EncodeResult, encode_tiles
from csplat.encoder.splat_importance import Importance
from csplat.encoder.target import Target, Views
from csplat.errors import InputError, SearchInterrupted
from csplat.model import SplatModel, check_model
from csplat.out_of_core import encode_on_disk, estimate_cost
from csplat.plugins import load_plugins
from csplat.ply.column_names import dropped_columns
from csplat.scene import Scene

#: Levels of detail: their number above the scene; "auto" for as many as it takes to reach 4,096 splats, "merged" for
#: the same without a fit to renders; or a builder.
Levels = int | Literal["auto", "merged"] | LevelBuilder | None

Output = str | os.PathLike[str] | BinaryWriter


class Search(Protocol):
    """A search that meets a target by rendering; an entry point of `csplat.search`."""

    def __call__(
        self,
        model: SplatModel,
        options: EncodeOptions,
        *,
        target: Target,
        views: Views | None,
        importance: NDArray[Any] | Importance | None,
        levels: LevelBuilder | None,
        context: Context,
    ) -> EncodeResult:
        """Return the best file within the target; arguments as for `encode_with_report`."""
        ...


@overload
def encode(
    scene: SplatModel | Scene,
    options: EncodeOptions | None = None,
    *,
    out: None = None,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    context: Context = DEFAULT_CONTEXT,
) -> bytes: ...


@overload
def encode(
    scene: SplatModel | Scene,
    options: EncodeOptions | None = None,
    *,
    out: Output,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    context: Context = DEFAULT_CONTEXT,
) -> None: ...


def encode(
    scene: SplatModel | Scene,
    options: EncodeOptions | None = None,
    *,
    out: Output | None = None,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    context: Context = DEFAULT_CONTEXT,
) -> bytes | None:
    """Encode a scene. Its metadata are written as they are: `csplat_render.first_view` adds a first view for viewers.

    A `UserWarning` names extra columns that are not kept, as do the notes of `encode_with_report`.

    A scene that does not fit in memory is encoded on disk, if `out` is a path, with the same bytes: it is sorted into
    buckets of neighbours in a working folder, and these are coded one by one, by worker processes. If the encoding is
    interrupted, finished work stays in the folder. Scripts must guard their own code by `if __name__ == "__main__":`,
    because worker processes import it.

    Args:
        scene: a model, or a scene of any size from `csplat.open`.
        options: default: the preset "balanced". With a target, options that are set are not changed by the search; the
            preset "fast" tries no codebooks and keeps all splats.
        out: a path, written atomically and replaced if it exists, or an open binary file; `None`: return the bytes.
        target: the target that a search meets; `None`: encode with the options as they are. All targets but largest
            errors alone require rendering, which takes minutes. A target requires the scene in memory.
        views: a `csplat_tools.ViewSet` of training, validation and test views for the search; `None`: virtual ones
            around the scene.
        importance: see `EncodePlan.of`; requires the scene in memory.
        levels: number of levels of detail above the scene, 1 to 16, "auto", "merged" or a builder (see `Levels`);
            their bytes count for a target. Building them takes minutes per million splats, and merged ones 20 seconds.
            `None`: the file has none.
        context: threads, workers, memory, seed and progress.

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
        >>> with csplat.open("scene.ply") as scene:
        ...     csplat.encode(scene, out="small.csplat", context=csplat.Context(memory="4GB"))
        >>> csplat.encode(model, out="small.csplat", target=csplat.Target(psnr=38), levels="auto")  # doctest: +SKIP

    Raises:
        InputError: `scene` is neither a model nor a scene, a value fits no lattice, an option is not allowed for the
            scene or is determined by the target, the target is out of reach; memory or disk are too small, the working
            folder exists, belongs to another scene or is damaged.
        CsplatError: the scene cannot be read.
        OSError: a file cannot be read or written; or a worker was killed.
        SearchInterrupted: Ctrl-C interrupted a search for a target; a `KeyboardInterrupt`. If a file so far meets the
            target, `best` is the `EncodeResult` of the best, which has been written to `out`.
    """
    result = encode_with_report(
        scene, options, out=out, target=target, views=views, importance=importance, levels=levels, context=context
    )
    for note in _list_losses(scene, options):
        warnings.warn(note, stacklevel=2)
    return result.data if out is None else None


def encode_with_report(
    scene: SplatModel | Scene,
    options: EncodeOptions | None = None,
    *,
    out: Output | None = None,
    target: Target | None = None,
    views: Views | None = None,
    importance: NDArray[Any] | Importance | None = None,
    levels: Levels = None,
    context: Context = DEFAULT_CONTEXT,
) -> EncodeResult:
    """Encode a scene, and report choices and errors; arguments and errors as in `encode`.

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
    """
    options = EncodeOptions() if options is None else options
    if not isinstance(options, EncodeOptions):
        raise InputError(f"options is {options!r}, expected csplat.EncodeOptions(preset=...)")
    if target is None and views is not None:
        raise InputError("views are given without a target, expected both or neither")
    if not isinstance(target, Target | None):
        raise InputError(f"target is {target!r}, expected csplat.Target(psnr=...)")
    if not isinstance(scene, Scene):
        check_model("the encoder", scene)
        scene = Scene.of(scene)
    builder = _builder_of(levels, scene.count, options)
    notes = _list_losses(scene, options)
    if target is not None or importance is not None:
        if context.is_bounded:
            raise InputError("a target and an importance exclude workers, a limit of memory, and resume")
    elif scene.in_memory is None or context.is_bounded:
        path = out if isinstance(out, str | os.PathLike) else None
        cost = estimate_cost(scene, options, context, builder, out=path)
        if not cost.in_memory:
            if path is None:
                raise InputError(
                    "the scene is encoded on disk, because it exceeds memory or workers are set: out must be a path"
                )
            return EncodeResult(encode_on_disk(scene, path, options, cost, context, builder)).with_notes(*notes)
    try:
        result = _encode_model(scene.model(), options, target, views, importance, builder, context)
    except SearchInterrupted as interrupt:
        if interrupt.best is not None:
            _write(interrupt.best, out)
        raise
    _write(result, out)
    return result.with_notes(*notes)


def _list_losses(scene: SplatModel | Scene, options: EncodeOptions | None) -> list[str]:
    """Return a line that names the extra columns that are not kept, if there are any."""
    return [dropped_columns(list(scene.extra)).text] if scene.extra and not (options and options.keep_extra) else []


def _write(result: EncodeResult, out: Output | None) -> None:
    """Write a file, whole or not at all, unless `out` is `None`."""
    if out is not None:
        with open_writer(out) as stream:
            stream.write(result.data)


def _encode_model(
    model: SplatModel,
    options: EncodeOptions,
    target: Target | None,
    views: Views | None,
    importance: NDArray[Any] | Importance | None,
    levels: LevelBuilder | None,
    context: Context,
) -> EncodeResult:
    """Encode a model in memory, with or without a target; arguments as in `encode_with_report`.

    A rendered target is met by the installed search. Error bounds are met without levels first; the scene is
    then encoded again with levels and the options found.
    """
    if target is None:
        return encode_planned(EncodePlan.of(model, options, importance=importance, context=context), levels)
    if target.max_error and isinstance(importance, Importance):
        importance = replace(importance, sh_metric=None)  # the errors of projected colours would not be known
    if target.is_rendered:
        search: Search = _plugin("csplat.search", "target", "search for targets")
        return search(model, options, target=target, views=views, importance=importance, levels=levels, context=context)
    bounded, options = meet_bounds(model, options, target, importance=importance, context=context)
    if levels is None:
        return bounded
    report = bounded.report.search
    assert report is not None
    result = encode_planned(EncodePlan.of(model, options, importance=importance, context=context), levels)
    return result.with_search(replace(report, size_bytes=result.size_bytes))


def encode_planned(
    plan: EncodePlan, levels: LevelBuilder | None = None, metadata: Mapping[str, Any] | None = None
) -> EncodeResult:
    """Encode a planned scene in memory.

    Args:
        plan: the plan.
        levels: builds levels of detail; `None`: the file has none.
        metadata: see `EncodedTiles.write`.

    Raises:
        InputError: a value fits no lattice, or an error is too large to be declared.
    """
    if levels is None:
        return encode_tiles(plan).write(metadata)
    return levels.encode_plan(plan).write({**(metadata or {}), "levels": levels.settings(len(plan.model))})


def _builder_of(levels: Levels, count: int, options: EncodeOptions) -> LevelBuilder | None:
    """Return a builder as it is, `None` for no levels, or the builder for a number or name of levels."""
    if levels is None or not isinstance(levels, int | str):
        return levels
    builder: LevelBuilder | None = _plugin("csplat.levels", "builder", "builder of levels of detail")(
        count, options, levels
    )
    return builder


def _plugin(group: str, name: str, what: str) -> Any:
    """Load an entry point of a group; raise an `InputError` that names the feature `what` if it is absent."""
    plugin = load_plugins(group).get(name)
    if plugin is None:
        raise InputError(f"no {what} is installed (entry points of {group}): csplat has to be installed as a whole")
    return plugin
