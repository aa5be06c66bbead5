# SPDX-License-Identifier: Apache-2.0
"""Reports of the inspecting commands as text: tables and lines for people."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from csplat.errors import counted
from csplat_tools.console import format_table
from csplat_tools.inspect.file_description import (
    AttributeSummary,
    CodebookSummary,
    FileDescription,
    LayerSummary,
    LevelSummary,
    describe_coding,
    describe_scene,
    format_headline,
    other_metadata,
)
from csplat_tools.views import describe_views

if TYPE_CHECKING:
    from csplat.decoder import DeclaredBounds
    from csplat_conformance.declared_bounds import BoundsVerification, MeasureVerification
    from csplat_tools.inspect.comparison import AttributeErrors, Comparison
    from csplat_tools.inspect.verification import Verification

_PAIRING = {
    "index": "pairs from the source index",
    "order": "pairs by their order",
    "search": "pairs found within the declared errors",
}
_SCORE_EXPLANATIONS = {
    "psnr": "of the squared error over all views; differences are visible at 30 dB, hardly at 40",
    "psnr_mean": "mean of the views' own",
    "psnr_worst": "of the worst view",
    "psnr_covered": "of pixels that show more than the background",
    "ssim": "structural similarity, 1 at best",
    "lpips": "perceptual distance by a trained network, 0 at best",
    "psnr_between": "PSNR of views halfway between cameras",
    "psnr_beside": "of views turned by up to 15 degrees, to the sides, up and down",
    "psnr_beyond": "of views up to 1.5 times as far away",
    "cover": "fraction of the pixels that show more than the background",
}
_GROUPS = {"colour": "colour (largest of the SH coefficients)", "opacity": "opacity", "shape": "shape, over its size"}


def format_comparison(compared: Comparison, a: str, b: str) -> str:
    """Format a comparison: sizes, errors of splats, scores.

    Args:
        compared: the comparison.
        a, b: names of the scenes.
    """
    parts = [_scene_sizes(compared, a, b)]
    if compared.attributes is None:
        parts.append("the errors of splats are unknown: `encode --source-index` writes the pairs of splats")
    else:
        parts.append(_attribute_errors(compared.attributes))
    parts.append(_scores(compared))
    if compared.images is not None:
        parts.append(_image_scores(compared.images))
    parts.append(f"{compared.seconds:.1f} s")
    return "\n\n".join(parts)


def _scene_sizes(compared: Comparison, a: str, b: str) -> str:
    """Format the sizes of two scenes named `a` and `b` as a table, and their ratio as a line below."""
    rows = []
    for name, scene in ((f"A  {a}", compared.a), (f"B  {b}", compared.b)):
        count = scene.count
        per_splat = f"{scene.size_bytes / count:.2f}" if count else "-"
        rows.append((name, scene.size_bytes, count, scene.sh_degree, per_splat))
    table = format_table(("", "bytes", "splats", "SH", "bytes/splat"), rows)
    ratio = compared.ratio
    return f"{table}\nB is {ratio:.2f} times smaller than A" if ratio >= 1.0 else f"{table}\nB is larger than A"


def _attribute_errors(attributes: AttributeErrors) -> str:
    """Format the errors of splats by measure, and how pairs were found."""
    rows = [(name, f"{largest:.4g}", f"{rms:.4g}") for name, (largest, rms) in attributes.errors.items()]
    remark = _PAIRING[attributes.pairing]
    if attributes.unmatched:
        remark += f"; {counted(attributes.unmatched, 'splat')} of B without one in A"
    return format_table(("error", "max", "rms"), rows) + f"\n{remark}"


def _scores(compared: Comparison) -> str:
    """Format the scores of renders, one line each with an explanation; scores that were not measured are left out.

    Lines on splats that are not drawn, and on different antialiasing, follow.
    """
    quality = compared.quality
    values = {
        "psnr": f"{quality.psnr:.2f} dB",
        "psnr_mean": f"{quality.psnr_mean:.2f} dB",
        "psnr_worst": f"{quality.psnr_worst:.2f} dB",
        "psnr_covered": None if quality.psnr_covered is None else f"{quality.psnr_covered:.2f} dB",
        **{f"psnr_{kind}": f"{psnr:.2f} dB" for kind, psnr in compared.elsewhere.items()},
        "ssim": None if quality.ssim is None else f"{quality.ssim:.5f}",
        "lpips": None if quality.lpips is None else f"{quality.lpips:.5f}",
        "cover": None if quality.cover is None else f"{100.0 * quality.cover:.1f} %",
    }
    rows = [(name, text) for name, text in values.items() if text is not None]
    views = describe_views(len(quality.each), compared.cameras)
    head, *others = format_table(("renders", views), rows).splitlines()
    lines = [head, *(f"{line}  {_SCORE_EXPLANATIONS[name]}" for line, (name, _) in zip(others, rows, strict=True))]
    lines += _ignored_lines(compared)
    if compared.a.metadata.antialiased != compared.b.metadata.antialiased:
        lines.append(f"only {'A' if compared.a.metadata.antialiased else 'B'} is antialiased, and was rendered so")
    return "\n".join(lines)


def _image_scores(scores: dict[str, Any]) -> str:
    """Format the scores of renders of both scenes against images; metrics that one lacks are left out."""
    rows = []
    decibels = ("psnr", "psnr_mean", "psnr_worst", "psnr_covered")
    for name, digits in (*((one, 2) for one in decibels), ("ssim", 5), ("lpips", 5)):
        a, b = scores["a"][name], scores["b"][name]
        if a is not None and b is not None:
            rows.append((name, f"{a:.{digits}f}", f"{b:.{digits}f}", f"{b - a:+.{digits}f}"))
    header = (f"against {scores['a']['views']} {scores['split']} images", "A", "B", "B - A")
    worst = [scores[scene]["worst_image"] for scene in ("a", "b")]
    return f"{format_table(header, rows)}\nthe worst image is {worst[0]} in A, {worst[1]} in B"


def _ignored_lines(compared: Comparison) -> list[str]:
    """Return a line for each scene with splats that cannot be drawn."""
    return [
        f"{counted(count, 'splat')} of {name} with NaN or infinities, not drawn"
        for name, count in zip("AB", (compared.ignored, compared.quality.ignored), strict=True)
        if count
    ]


def format_description(description: FileDescription) -> str:
    """Format the description of a file: scene, sizes, codebooks, declared errors, options, metadata."""
    size = description.header.file_size
    parts = [
        _scene_lines(description),
        _entry_sizes(
            "attribute",
            description.attributes,
            size,
            [describe_coding(attribute) for attribute in description.attributes.values()],
        ),
        _entry_sizes(
            "layer", description.layers, size, [counted(layer.tiles, "tile") for layer in description.layers.values()]
        ),
        *([_level_table(description.levels)] if description.levels else []),
        "other bytes: " + ", ".join(f"{name} {number}" for name, number in description.overhead.items()),
    ]
    if description.codebooks:
        parts.append("\n".join(_codebook_line(codebook) for codebook in description.codebooks))
    if description.declared_bounds is not None:
        parts.append(_declared_errors(description.declared_bounds))
    parts += [
        f"{title}  {json.dumps(value, sort_keys=True)}"
        for title, value in (("options ", description.options), ("metadata", other_metadata(description)))
        if value
    ]
    return "\n\n".join(parts)


def _level_table(levels: Sequence[LevelSummary]) -> str:
    """Format the levels of detail as a table, with least and largest error of each."""
    rows = [
        (
            str(level.level), level.size_bytes, level.splats, level.nodes, level.tiles,
            " to ".join(f"{error:.3g}" for error in sorted({*level.errors})),
        )
        for level in levels
    ]  # fmt: skip
    return format_table(("level", "bytes", "splats", "nodes", "tiles", "errors, scene units"), rows)


def _scene_lines(description: FileDescription) -> str:
    """Format the headline of a file, and a line for each entry on the scene."""
    return "\n".join(
        [format_headline(description), *(f"{name:12} {value}" for name, value in describe_scene(description).items())]
    )


def _entry_sizes(
    title: str, entries: Mapping[str, AttributeSummary | LayerSummary], file_size: int, remarks: Sequence[str]
) -> str:
    """Format sizes of attributes or layers as a table, with a remark at the end of each line.

    Args:
        title: heading of the names.
        entries: attributes or layers by name.
        file_size: bytes of the file, above 0.
        remarks: one for each entry; may be empty.
    """
    rows = [
        (
            name,
            entry.size_bytes,
            "-" if entry.bits_per_splat is None else f"{entry.bits_per_splat:.2f}",
            f"{100.0 * entry.size_bytes / file_size:.1f}",
        )
        for name, entry in entries.items()
    ]
    lines = format_table((title, "bytes", "bits/splat", "% of file"), rows).splitlines()
    return "\n".join(f"{line}  {text}".rstrip() for line, text in zip(lines, ["", *remarks], strict=True))


def _codebook_line(codebook: CodebookSummary) -> str:
    """Format a codebook as a line: id, kind, SH bands if it has any, entries and bytes."""
    bands = f" bands {codebook.bands[0]} to {codebook.bands[-1]}" if codebook.bands else ""
    size = f"{counted(codebook.entries, 'entry', 'entries')}, {counted(codebook.size_bytes, 'byte')}"
    return f"codebook {codebook.id}: {codebook.kind}{bands}, {size}"


def _declared_errors(declared: DeclaredBounds) -> str:
    """Format the counts of the source and the declared errors."""
    source = f"{counted(declared.source_count, 'splat')}, SH degree {declared.source_sh_degree}"
    lines = [f"source: {source}; {declared.pruned_count} pruned"]
    if declared.refitted:
        lines.append("attributes were refitted: those without an error here are checked by renders only")
    if declared.records:
        rows = [(record.measure, f"{record.max:.6g}", f"{record.rms:.6g}") for record in declared.records]
        lines.append(format_table(("declared error", "max", "rms"), rows))
    return "\n".join(lines)


def format_verification(verified: Verification) -> str:
    """Format the result of a verification: violations, and the verified errors."""
    validation, bounds = verified.validation, verified.bounds
    lines = [
        *map(str, (*validation.violations, *validation.unread)),
        *(f"remark: {remark}" for remark in validation.remarks),
    ]
    if validation.conforms:
        lines.append(f"intact: {counted(validation.splat_count, 'splat')}; checked: {', '.join(validation.checks)}")
    if bounds is not None:
        if bounds.measures:
            lines.append(_measure_table(bounds))
        lines += bounds.notes
        if bounds.holds:
            lines.append(_verdict(bounds))
    return "\n".join(lines)


def _verdict(bounds: BoundsVerification) -> str:
    """Return the verdict on bounds of which none is violated; maxima alone hold if RMS errors were not verified."""
    if not any(measure.holds for measure in bounds.measures):
        return "the file declares no errors that could be verified"
    return "the declared errors hold" if bounds.rms_verified else "the declared maxima hold"


def _measure_table(bounds: BoundsVerification) -> str:
    """Format the verified errors, with measured values if those were measured."""
    if bounds.rms_verified:
        header = ("error", "declared max", "found max", "declared rms", "found rms", "")
        rows = [
            (
                measure.name,
                *map(_number, (measure.declared_max, measure.measured_max, measure.declared_rms, measure.measured_rms)),
                _word(measure),
            )
            for measure in bounds.measures
        ]
        return format_table(header, rows)
    rows = [(measure.name, _number(measure.declared_max), _word(measure)) for measure in bounds.measures]
    return format_table(("error", "declared max", ""), rows)


def _word(measure: MeasureVerification) -> str:
    return "not proved" if measure.holds is None else "holds" if measure.holds else "FAILS"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def format_simplification(report: Mapping[str, Any]) -> list[str]:
    """Format the report of a simplification as lines: counts, views, PSNR."""
    removed, views = report["removed"], report["views"]
    before, after = report["splats_before"], report["splats"]
    pruned = (
        f"{removed['invisible']} too faint to be drawn, {removed['unseen']} unseen,"
        f" {removed['least_error']} that renders need least"
    )
    size = f"{views['size'][0]}x{views['size'][1]}"
    unseen = f"{100.0 * report['unseen_share']:.1f} % of the splats were seen by none"
    lines = [
        f"{before:,} -> {counted(after, 'splat')} ({100.0 * after / before:.1f} %); pruned: {pruned}",
        f"measured in {counted(views['used'], 'view')} of {size}, checked in {views['check']} others; {unseen}",
    ]
    rows = [("the other views, before the fit", f"{report['check_psnr_pruned']:.2f}")]
    rows.append(("the other views, fitted", f"{report['check_psnr']:.2f}"))
    if "validation_psnr" in report:
        rows.append(("validation views", f"{report['validation_psnr']:.2f}"))
    if "psnr" in report:
        rows.append((f"{report['test_views']['views']} test views", f"{report['psnr']:.2f}"))
    if "images" in report:
        scores = report["images"]
        rows.append(("held-out images, source", f"{scores['source']:.2f}"))
        rows.append(("held-out images", f"{scores['psnr']:.2f}"))
    lines.append(format_table(("PSNR", "dB"), rows))
    return lines


def format_sensitivity(report: Mapping[str, Any]) -> list[str]:
    """Format the report of measured sensitivities as lines: counts and quantiles."""
    unseen = f"no view saw {report['unseen']} of them ({100.0 * report['unseen_share']:.2f} %)"
    lines = [
        f"{counted(report['splats'], 'splat')} from {counted(report['views'], report['source'] + ' view')}; {unseen}"
    ]
    if report["missed_share"] is not None:
        lines.append(f"held-out views saw {100.0 * report['missed_share']:.2f} % more of the splats")
    rows = [
        (label, *(f"{report['quantiles'][name][q]:.3g}" for q in ("0.5", "0.9", "0.99", "1.0")))
        for name, label in _GROUPS.items()
    ]
    return [*lines, format_table(("sensitivity", "median", "90 %", "99 %", "largest"), rows)]
