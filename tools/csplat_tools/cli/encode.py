"""`csplat encode`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from csplat._spec import MEASURE_NAMES
from csplat.encoder import EncodeOptions
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_render.up_estimate import estimate_up
from csplat_tools.cli.command import LibrarySettings, OptionGroup, OutputOptions, command
from csplat_tools.cli.shared_options import (
    EFFORT,
    ENCODER_SETTINGS,
    EncodingOptions,
    Importance,
    SourceIndex,
    SourceOptions,
    ViewOptions,
    VirtualViewOptions,
    parse_bytes,
    parse_decibels,
)
from csplat_tools.console import format_bytes, format_estimate, format_table, note
from csplat_tools.encode_file import (
    EncodedFile,
    EncodeFunction,
    EncoderOutcome,
    OutOfCoreOptions,
    encode_file,
    estimate_cost,
)
from csplat_tools.file_streams import check_name, source_path
from csplat_tools.inspect.comparison import ESTIMATE_SIZE, ESTIMATE_SPLATS_MAX, estimate_psnr
from csplat_tools.optional_packages import prepare_renderer, require_renderer

if TYPE_CHECKING:
    from csplat_tools.optimise.targets import Target


_TARGET = "Targets (one of the first four, which require the render extra)"
_ROOM = "Large scenes"
_RENDERED = ("target_psnr", "target_size", "max_psnr_drop", "keep")
_WHOLE = (*_RENDERED, "max_error", "importance", "source_index")  # options that need the scene in memory


@dataclass(frozen=True)
class TargetOptions(OptionGroup):
    """Options of the target that the file is to meet."""

    one_of: ClassVar[Sequence[tuple[str, ...]]] = (_RENDERED, ("keep", "no_prune"), ("effort", "no_prune"))
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "max_psnr_drop": ("data",),
        "no_prune": ("target_psnr", "target_size", "max_psnr_drop", "max_error"),
    }

    target_psnr: Annotated[
        str | None,
        typer.Option(metavar="DB", rich_help_panel=_TARGET, help="Least PSNR against source renders."),
    ] = None
    target_size: Annotated[
        str | None,
        typer.Option(metavar="5MB", rich_help_panel=_TARGET, help="Largest size of the file."),
    ] = None
    max_psnr_drop: Annotated[
        str | None,
        typer.Option(metavar="DB", rich_help_panel=_TARGET, help="Largest PSNR drop, against --data."),
    ] = None
    keep: Annotated[
        float | None,
        typer.Option(metavar="SHARE", rich_help_panel=_TARGET, help="Share of splats to keep, refitted."),
    ] = None
    max_error: Annotated[
        str | None,
        typer.Option(
            metavar="means=0.001,...",
            rich_help_panel=_TARGET,
            help="Largest error, by measure.",
        ),
    ] = None
    no_prune: Annotated[
        bool, typer.Option("--no-prune", rich_help_panel=_TARGET, help="Prune and refit no splat: faster.")
    ] = False
    effort: Annotated[int, typer.Option(rich_help_panel=_TARGET, **EFFORT)] = 3

    @property
    def is_rendered(self) -> bool:
        """True if meeting the target requires rendering."""
        return any(getattr(self, name) is not None for name in _RENDERED)

    def read(self, unit_metres: float | None) -> Target | None:
        """Return the target; `None` if no option specifies one.

        Args:
            unit_metres: length of a scene unit in metres, if known.

        Raises:
            InputError: the target is invalid.
        """
        if not self.is_rendered and self.max_error is None:
            return None
        from csplat_tools.optimise.targets import Target, parse_max_error  # imports names of the renderer

        size = parse_bytes(self.target_size)
        loss = None if self.max_psnr_drop is None else parse_decibels(self.max_psnr_drop)
        bounds = {} if self.max_error is None else parse_max_error(self.max_error, unit_metres)
        psnr = None if self.target_psnr is None else parse_decibels(self.target_psnr)
        return Target(psnr, size, loss, self.keep, bounds)


@dataclass(frozen=True)
class LargeSceneOptions(OptionGroup):
    """Options for encoding scenes larger than memory."""

    memory: Annotated[
        str | None,
        typer.Option(
            metavar="2GB",
            rich_help_panel=_ROOM,
            hidden=True,
            help="Memory of all processes. Default: half of what is free.",
        ),
    ] = None
    work: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER", rich_help_panel=_ROOM, hidden=True, help="Working folder on the disk. Default: OUT.work."
        ),
    ] = None
    resume: Annotated[
        bool, typer.Option("--resume", rich_help_panel=_ROOM, hidden=True, help="Continue an interrupted encoding.")
    ] = False
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            rich_help_panel=_ROOM,
            hidden=True,
            help="Use the workers of a Dask cluster, which have the --work folder under the same name.",
        ),
    ] = None
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", rich_help_panel=_ROOM, hidden=True, help="Estimate memory, disk and time, and encode nothing."
        ),
    ] = False

    def read(self) -> OutOfCoreOptions:
        """Return the options as the library takes them.

        Raises:
            InputError: --memory is not a size.
        """
        return OutOfCoreOptions(parse_bytes(self.memory), self.work, self.resume, self.dask)


@command(
    beside=".csplat",
    reads=True,
    one_of=(
        ("prune_unseen", *_RENDERED),
        ("prune_unseen", "max_error"),
        ("attribute_psnr", "target_psnr", "target_size", "max_psnr_drop"),
        ("keep", "importance"),
        *((name, other) for name in ("memory", "work", "resume", "dask", "dry_run") for other in _WHOLE),
    ),
    needs={
        "prune_unseen": ("importance",),
        "effort": _RENDERED,
        "cameras": _RENDERED,
        "data": _RENDERED,
        "views": _RENDERED,
        "view_size": _RENDERED,
        "background": ("cameras", "data"),
    },
    settings=(ENCODER_SETTINGS,),
)
def encode(
    source: Annotated[str, typer.Argument(metavar="IN.ply", help="A PLY, other `csplat formats`, or -.")],
    output: Annotated[str, typer.Argument(metavar="OUT.csplat", help="The file to write, or -; else IN.csplat.")],
    encoding: EncodingOptions,
    goal: TargetOptions,
    source_options: SourceOptions,
    views: ViewOptions,
    virtual: VirtualViewOptions,
    room: LargeSceneOptions,
    out: OutputOptions,
    settings: LibrarySettings,
    importance: Importance = None,
    prune_unseen: Annotated[
        bool, typer.Option("--prune-unseen", hidden=True, help="Prune splats that no view of --importance saw.")
    ] = False,
    source_index: SourceIndex = None,
) -> None:
    """Compress a trained 3DGS scene.

    Repairs what is safe to repair, and declares how far the file's splats are
    from the source. A target chooses all options, and the splats to prune.

    --preset, of 60,000 splats of SH degree 3, 14.9 MB, on one core:
      fast      719 kB, 42.9 dB, 0.4 s: for previews and experiments
      balanced  645 kB, 42.7 dB, 4 s: for archives and publication
      small     529 kB, 38.6 dB, 4 s: if bytes matter more than precision

    Examples:
      csplat encode scene.ply scene.csplat
      csplat encode scene.ply scene.csplat --preset small --sh-degree 2
      csplat encode scene.ply scene.csplat --target-psnr 40
      csplat encode scene.ply scene.csplat --target-size 5MB --no-prune
    ---
    Splats are fitted to training views, files are compared by validation views,
    and the result is scored by test views, which also decide if it reaches
    --target-psnr. --preset fast and --max-error keep all splats as they are, as
    --no-prune does. --max-error bounds means, covariance (relative), opacities,
    sh0, sh1, sh2, sh3; a length may have a unit, such as mm, if the scene's is
    known.

    A scene that does not fit the memory is sorted into buckets on the disk, in
    OUT.csplat.work, and coded by --threads processes. The bytes are the same.
    --resume continues after an interrupt.

    More examples:
      csplat encode scene.ply scene.csplat --keep 0.5
      csplat encode scene.ply scene.csplat --max-psnr-drop 0.3dB --data photographs
      csplat encode scene.ply scene.csplat --max-error means=0.001,sh0=0.02
      csplat encode scene.ply scene.csplat --set position-bits=12,sh-coding=scalar
      csplat sensitivity scene.ply scene.npz --data photographs
      csplat encode scene.ply scene.csplat --importance scene.npz
      csplat encode scene.ply scene.csplat --source-index scene.npy
      csplat verify scene.csplat --source scene.ply --source-index scene.npy
      csplat encode city.ply city.csplat --memory 4GB
      csplat encode city.ply city.csplat --memory 4GB --dry-run
      gunzip -c scene.ply.gz | csplat encode - - | wc -c
    """
    options = encoding.options(source_options, settings)
    if (options.max_classes or 1) > 1:
        if options.shape_codebook_size:
            raise typer.BadParameter("--max-classes with a codebook of shapes: its entries have one precision")
        if not goal.is_rendered and importance is None:
            raise typer.BadParameter("--max-classes requires a target or --importance: views sort the splats")
    try:  # errors of the target that do not depend on the scene
        goal.read(1.0)
    except InputError as error:
        raise typer.BadParameter(str(error)) from None
    scale = room.read()
    if room.dry_run:
        _say_expected(source, options, scale, out)
        return
    out.check(output, inputs=(source, importance, *views.inputs), named={"--source-index": source_index})
    check_name(output, ".csplat", "encode", source)
    if goal.is_rendered:
        require_renderer()
    reaching: EncodeFunction = partial(_reach, goal, views, virtual, importance, out)
    with out.bar() as progress:
        encoded = encode_file(
            source, output, options, overrides=source_options.read(), strict=source_options.strict,
            importance=importance, prune_unseen=prune_unseen, source_index=source_index, scale=scale,
            encoder=reaching if goal.is_rendered or goal.max_error is not None else None, progress=progress,
        )  # fmt: skip
    out.print_findings(encoded.findings)
    for line in encoded.report.notes:
        note(line)
    out.remark(*(() if encoded.outcome is None else encoded.outcome.lines), *_stated(encoded))
    with out.bar() as progress:
        if progress is not None:
            progress("eight small renders", 0.0)
        psnr = None if out.quiet else _psnr(encoded, encoding.threads)
    about = {} if psnr is None else {"psnr": round(psnr, 2), "size": list(ESTIMATE_SIZE)}
    if not out.quiet and encoded.outcome is not None and len(encoded.source) <= ESTIMATE_SPLATS_MAX:
        source_options.take_estimated_up(estimate_up(encoded.source), out, shown=False)
    out.remark(_summary(encoded, psnr, source, output))
    out.publish({**encoded.as_json(), "about": about} if about else encoded.as_json())


def _say_expected(source: str, options: EncodeOptions, scale: OutOfCoreOptions, out: OutputOptions) -> None:
    """Report memory, disk space and time that an encoding would take."""
    with source_path(source) as local, out.bar() as progress:
        if progress is not None:
            progress("opening", 0.0)
        found = estimate_cost(local, options, scale)
    needs = found.needs
    where = "in memory" if needs.in_memory else f"by way of the disk, {counted(needs.workers, 'process', 'processes')}"
    text = (
        f"{counted(found.count, 'splat')} of SH degree {found.sh_degree}, {where}: about"
        f" {format_estimate(found.seconds)}, {format_bytes(needs.memory_bytes)} of memory,"
        f" {format_bytes(needs.disk_bytes)} of disk; the file about {format_bytes(found.file_bytes)}"
    )
    out.publish(found.as_json(), text)


def _reach(
    goal: TargetOptions,
    views: ViewOptions,
    virtual: VirtualViewOptions,
    importance: str | None,
    out: OutputOptions,
    model: SplatModel,
    encoding: EncodeOptions,
    progress: Progress | None,
) -> EncoderOutcome:
    """Encode a scene to the target; called by `encode_file` with the last three arguments."""
    import csplat_tools
    from csplat_tools.importance_file import read_encoder_importance

    target, around = goal.read(model.unit_metres), None
    assert target is not None
    weights = None if importance is None else read_encoder_importance(importance, model)
    simplifying = None
    if target.is_rendered:
        prepare_renderer(quiet=out.quiet, simplify=True)
        from csplat_tools.optimise.pruning_order import SimplifyOptions
        from csplat_tools.optimise.target_search import expected_seconds

        given = virtual.given()
        simplifying = SimplifyOptions(effort=goal.effort, view_size=given.get("size"))
        around = views.find(model, out, **given)
        if len(model) and around.test:
            may_prune = not goal.no_prune and goal.keep is None
            out.announce_time(
                partial(
                    expected_seconds, model, encoding, target, around, no_prune=goal.no_prune, simplifying=simplifying
                ),
                "--no-prune takes a sixth of that, a preset seconds" if may_prune else "a preset takes seconds",
            )
    made = csplat_tools.encode_to(
        model, psnr=target.psnr, size=target.size_bytes, max_psnr_drop=target.max_psnr_drop, keep=target.keep,
        errors=target.max_error, views=around, options=encoding, no_prune=goal.no_prune, importance=weights,
        simplifying=simplifying, progress=progress,
    )  # fmt: skip
    return EncoderOutcome(made.result, "target", made.report.as_json(), made.report.lines())


def _stated(encoded: EncodedFile) -> list[str]:
    errors = encoded.report.errors
    names = sorted(errors, key=list(MEASURE_NAMES.values()).index)
    rows = [(name, *(f"{value:.4g}" for value in errors[name])) for name in names]
    return [format_table(("stated error", "max", "rms"), rows)] * bool(rows)


def _psnr(encoded: EncodedFile, threads: int | None) -> float | None:
    """Return an approximate PSNR in dB; `None` if it is known already, or if measuring it would take long."""
    outcome = encoded.outcome
    if outcome is None or outcome.report.get("psnr") is not None or find_spec("numba") is None:
        return None
    return estimate_psnr(encoded.source, outcome.result.data, threads=threads)


def _summary(encoded: EncodedFile, psnr: float | None, source: str, output: str) -> str:
    """Return the last line: counts, time, sizes and quality."""
    report = encoded.report
    per_splat = f" ({report.size_bytes / report.splat_count:.2f} bytes per splat)" if report.splat_count else ""
    ratio = encoded.source_bytes / report.size_bytes
    splats = f"{counted(report.splat_count, 'splat')} in {counted(report.tile_count, 'tile')}, {encoded.seconds:.2f} s"
    sizes = f"{format_bytes(encoded.source_bytes)} -> {format_bytes(report.size_bytes)}{per_splat}"
    quality, found = "", None if encoded.outcome is None else encoded.outcome.report.get("psnr")
    if psnr is not None:
        quality = f", about {psnr:.1f} dB (PSNR of eight small renders)"
    elif found is not None:
        quality = f", PSNR {found:.2f} dB"
    elif encoded.outcome is not None and len(encoded.source) and "-" not in (source, output):
        quality = f"; `csplat compare {source} {output}` says how it looks"
    return f"{splats}: {sizes}, {ratio:.1f} times smaller{quality}"
