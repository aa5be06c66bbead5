# SPDX-License-Identifier: CC0-1.0
"""Compare renders of a file with renders of its source (L4)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from csplat.decoder import DecodedScene, SceneHeader, decode
from csplat.decoder.tree import read_nodes, select_tiles
from csplat.model import SplatModel
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders.encoder_inputs import EncoderInput
from csplat_conformance.encoders.encoder_run import Verdict
from csplat_conformance.encoders.file_checks import SplatPairs

#: Returns the PSNR of renders in dB; called with the source and the decoded scene.
RenderScore = Callable[[SplatModel, SplatModel], float]


def check_renders(
    case: EncoderInput,
    source: Source,
    scene: DecodedScene,
    pairs: SplatPairs,
    data: bytes,
    render_score: RenderScore,
    psnr_min: float,
) -> Verdict:
    """Check L4: renders of the file match renders of the source. Coarser levels of detail are reported, not judged.

    Args:
        case: the input.
        source: the scene of the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.
        data: the file.
        render_score: computes the PSNR.
        psnr_min: lowest PSNR that passes, dB; see `EncoderInput.psnr_required`.
    """
    model, decoded = source.to_model(scene.model.origin), scene.model
    psnr = render_score(model, decoded)
    figures, required = peer_figures(case.name), case.psnr_required(psnr_min)
    details = {"psnr": psnr, "wanted": required, "bytes": len(data), "beside": figures}
    size = f"in {len(data):,} bytes{format_figures(figures)}"
    if scene.header.coarse_tiles:
        details["levels"] = levels = _score_levels(model, data, scene.header, render_score)
        size += "".join(f"; level {level} {value:.1f} dB" for level, value in levels.items())
    if not psnr >= required:
        details["exact"] = exact = _score_exact_attributes(model, decoded, pairs, render_score)
        cost = ", ".join(f"{name} {value:.1f}" for name, value in exact.items())
        blame = f"; with the source's {cost}" if cost else ""
        return Verdict(Status.FAILED, f"{psnr:.2f} dB, expected at least {required:g}, {size}{blame}", details=details)
    return Verdict(Status.PASSED, f"{psnr:.2f} dB {size}", details=details)


def _score_levels(source: SplatModel, data: bytes, header: SceneHeader, render_score: RenderScore) -> dict[str, float]:
    """Return the PSNR of each level of detail above 0, dB, by its number as text."""
    nodes = read_nodes(memoryview(data), header)
    levels = sorted({node.level for node in nodes if node.level})
    cuts = {level: [tile.index for tile in select_tiles(header, nodes, level=level)] for level in levels}
    return {str(level): render_score(source, decode(data, tiles=tiles)) for level, tiles in cuts.items()}


def _score_exact_attributes(
    source: SplatModel, decoded: SplatModel, pairs: SplatPairs, render_score: RenderScore
) -> dict[str, float]:
    """Return the PSNR, dB, with exact values of one attribute at a time: the largest gain shows the worst attribute.

    Empty unless every splat has a source splat.
    """
    if pairs.strays or pairs.surplus:
        return {}
    theirs = source.select(pairs.source_index)
    changes: dict[str, dict[str, Any]] = {
        "means": {"means": theirs.means},
        "shapes": {"quats": theirs.quats, "scales": theirs.scales},
        "opacities": {"opacities": theirs.opacities},
        "colours": {"sh0": theirs.sh0, "shN": theirs.shN},
    }
    return {name: render_score(source, replace(decoded, **arrays)) for name, arrays in changes.items()}


_FIGURES = Path(__file__).with_name("figures.json")
_DISPLAY_NAMES = {"spz": "SPZ"}


def peer_figures(name: str) -> dict[str, dict[str, Any]]:
    """Return `bytes` and `psnr` of an input by encoder, as far as measured."""
    return _all_figures().get(name, {})


def format_figures(figures: dict[str, dict[str, Any]]) -> str:
    """Format figures with a leading blank: ` (csplat 40.90 in 4,800, SPZ 39.10 in 7,900)`."""
    words = []
    for encoder, numbers in figures.items():
        psnr = f"{numbers['psnr']:.2f}" if numbers.get("psnr") is not None else ""
        size = f"in {numbers['bytes']:,}" if numbers.get("bytes") is not None else ""
        if psnr or size:
            words.append(" ".join(part for part in (_DISPLAY_NAMES.get(encoder, encoder), psnr, size) if part))
    return f" ({', '.join(words)})" if words else ""


@cache
def _all_figures() -> dict[str, dict[str, dict[str, Any]]]:
    """Read the figures of other encoders, by input and encoder; none if the package lacks the file."""
    if not _FIGURES.exists():
        return {}
    result: dict[str, dict[str, dict[str, Any]]] = json.loads(_FIGURES.read_text("utf-8"))
    return result
