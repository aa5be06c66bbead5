"""`csplat compare`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from csplat.disk_files import read_array
from csplat.errors import InputError, counted
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.shared_options import (
    Background,
    Cameras,
    Data,
    Force,
    HelpAll,
    Json,
    ModeOption,
    Quiet,
    Report,
    TestEvery,
    ViewOptions,
    require_one,
)
from csplat_tools.console import format_bytes, format_table
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.inspect.comparison import AttributeErrors
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.scene_files import OpenedScene, open_scenes
from csplat_tools.views import Split, describe_views

if TYPE_CHECKING:
    from csplat_tools.inspect.comparison import Comparison


_INDEX_BYTES = 1 << 27  # largest size of a source index, which is read as a whole

_PAIRING = {
    "index": "pairs from the source index",
    "order": "pairs by their order",
    "search": "pairs found within the stated errors",
}
_SCORE_EXPLANATIONS = {
    "psnr": "of the squared error over all views; at 30 dB people see a difference, at 40 they hardly do",
    "psnr_mean": "mean of the views' own",
    "psnr_worst": "of the view that came out worst",
    "psnr_covered": "of the pixels alone that show more than the background",
    "ssim": "likeness of structure, 1 at best",
    "lpips": "distance as a trained network sees it, 0 at best",
    "cover": "share of the pixels that show more than the background",
}


def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="The source, in any format.")],
    b: Annotated[str, typer.Argument(metavar="B", help="The scene that was made from it.")],
    cameras: Cameras = None,
    data: Data = None,
    background: Background = None,
    split: Annotated[
        Split, typer.Option(metavar="PART", show_default=False, help="test or train images. Default: test.")
    ] = "test",
    pictures: Annotated[
        str | None, typer.Option(metavar="FOLDER", help="Write renders of A, B, and differences.")
    ] = None,
    lpips: Annotated[
        str | None, typer.Option(metavar="FILE.npz", help="Compute LPIPS with these weights, or auto.")
    ] = None,
    mode: ModeOption = "standard",
    test_every: TestEvery = None,
    source_index: Annotated[
        str | None,
        typer.Option(metavar="FILE.npy", hidden=True, help="File of `encode --source-index`: pairs of splats."),
    ] = None,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
) -> None:
    """Compare a scene with its source: sizes, errors, and renders.

    `psnr` is pooled over all pixels of eight 640x480 views around A in front
    of black, or of the given views; at most 99 dB. Compare only values for
    the same cameras and background. With --data, A and B are also scored
    against the held-out images. Scenes that do not fit in memory are rendered
    from the disk. Requires the render extra.

    Examples:
      csplat compare scene.ply scene.csplat
      csplat compare scene.ply scene.csplat --data capture --lpips auto
      csplat compare scene.ply scene.csplat --pictures differences
      csplat compare scene.ply other.ply --cameras test.json --json | jq .psnr
    """
    import csplat_tools

    out = Output(force, report, as_json, quiet)
    views = ViewOptions(cameras, data, background, test_every)
    require_one({"--split": split != "test", "--test-every": test_every}, {"--data": data})
    out.check(inputs=(a, b, *views.inputs, source_index, None if lpips == "auto" else lpips))
    if a == b == STANDARD_STREAM:
        raise typer.BadParameter("A and B cannot both be standard input")
    require_renderer()
    rows = None if source_index is None else read_array(source_index, most_bytes=_INDEX_BYTES)
    with open_scenes((a, b)) as (source, other), out.bar() as progress:
        if isinstance(source, OpenedScene):
            if mode == "exact":
                raise InputError("--mode exact requires both scenes in memory, and they do not fit: use standard")
            out.remark(
                f"A and B do not fit in {format_bytes(source.memory_bytes)} of memory: they are rendered from the disk"
            )
        for name, one in ((a, source), (b, other)):
            out.print_findings(one.findings, Path(name).name)
        model, every = source.sample(progress)
        around = views.find(model, out, count=0, split=split, every=every)
        if mode == "exact":
            from csplat_tools.views.view_sets import total_render_seconds

            out.announce_time(
                lambda: 2 * total_render_seconds(model, around.test, mode=mode), "--mode standard takes seconds"
            )
        compared = csplat_tools.compare(
            source, other, views=around, source_index=rows, lpips=lpips, pictures=pictures, background=views.colour,
            mode=mode, force=out.force,
            prepare=partial(prepare_renderer, quiet=out.quiet, ssim=True, lpips=lpips is not None), progress=progress,
        )  # fmt: skip
    out.publish(compared.as_json(), _format(compared, Path(a).name, Path(b).name))
    if pictures is not None:
        out.remark(f"{counted(len(compared.quality.each), 'file')} in {pictures}")


def _format(compared: Comparison, a: str, b: str) -> str:
    parts = [_sizes(compared, a, b)]
    if compared.attributes is None:
        parts.append("the errors of splats are unknown: `encode --source-index` writes the pairs of splats")
    else:
        parts.append(_attributes(compared.attributes))
    parts.append(_quality(compared))
    if compared.image_scores is not None:
        parts.append(_format_image_scores(compared.image_scores))
    parts.append(f"{compared.seconds:.1f} s")
    return "\n\n".join(parts)


def _sizes(compared: Comparison, a: str, b: str) -> str:
    rows = []
    for name, one in ((f"A  {a}", compared.a), (f"B  {b}", compared.b)):
        count = one.count
        per_splat = f"{one.size_bytes / count:.2f}" if count else "-"
        rows.append((name, one.size_bytes, count, one.metadata_model.sh_degree, per_splat))
    table = format_table(("", "bytes", "splats", "SH", "bytes/splat"), rows)
    ratio = compared.ratio
    return f"{table}\nB is {ratio:.2f} times smaller than A" if ratio >= 1.0 else f"{table}\nB is larger than A"


def _attributes(attributes: AttributeErrors) -> str:
    rows = [(name, f"{largest:.4g}", f"{rms:.4g}") for name, (largest, rms) in attributes.errors.items()]
    remark = _PAIRING[attributes.pairing]
    if attributes.unmatched:
        remark += f"; {counted(attributes.unmatched, 'splat')} of B without one in A"
    return format_table(("error", "max", "rms"), rows) + f"\n{remark}"


def _quality(compared: Comparison) -> str:
    quality = compared.quality
    values = {
        "psnr": f"{quality.psnr:.2f} dB",
        "psnr_mean": f"{quality.psnr_mean:.2f} dB",
        "psnr_worst": f"{quality.psnr_worst:.2f} dB",
        "psnr_covered": None if quality.psnr_covered is None else f"{quality.psnr_covered:.2f} dB",
        "ssim": None if quality.ssim is None else f"{quality.ssim:.5f}",
        "lpips": None if quality.lpips is None else f"{quality.lpips:.5f}",
        "cover": None if quality.cover is None else f"{100.0 * quality.cover:.1f} %",
    }
    rows = [(name, text) for name, text in values.items() if text is not None]
    views = describe_views(len(quality.each), compared.cameras)
    head, *others = format_table(("pictures", views), rows).splitlines()
    lines = [head, *(f"{line}  {_SCORE_EXPLANATIONS[name]}" for line, (name, _) in zip(others, rows, strict=True))]
    lines += _ignored(compared)
    if compared.a.metadata_model.antialiased != compared.b.metadata_model.antialiased:
        lines.append(
            f"only {'A' if compared.a.metadata_model.antialiased else 'B'} is antialiased, and was rendered so"
        )
    return "\n".join(lines)


def _format_image_scores(scores: dict[str, Any]) -> str:
    rows = []
    for name, digits in (("psnr", 2), ("psnr_mean", 2), ("psnr_covered", 2), ("ssim", 5), ("lpips", 5)):
        a, b = scores["a"][name], scores["b"][name]
        if a is not None and b is not None:
            rows.append((name, f"{a:.{digits}f}", f"{b:.{digits}f}", f"{b - a:+.{digits}f}"))
    header = (f"against {scores['a']['views']} {scores['split']} photographs", "A", "B", "B - A")
    return format_table(header, rows)


def _ignored(compared: Comparison) -> list[str]:
    return [
        f"{counted(count, 'splat')} of {name} with NaN or infinities, not drawn"
        for name, count in zip("AB", (compared.ignored, compared.quality.ignored), strict=True)
        if count
    ]
