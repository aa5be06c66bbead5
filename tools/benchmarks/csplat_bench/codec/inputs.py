"""Measure the reference inputs of the encoder suite: sizes and pictures of ours and of SPZ.

    python -m csplat_bench.codec.inputs                         # all that render; one minute
    python -m csplat_bench.codec.inputs --scenes '*/surfaces,*/glossy' --markdown
    python -m csplat_bench.codec.inputs --write                 # figures.json of the suite, of all that can be encoded

A column has the quality of a file, in dB of `psnr`. SPZ is written and read by splat-transform, from a plain PLY of the
same splats: it is the format that is measured, not the PLY reader.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.ply import read_ply, write_ply
from csplat_bench.common.command import MARKDOWN, PEERS, preset_of, run
from csplat_bench.common.peers import find_splat_transform, judged, transform
from csplat_bench.common.report import table, tell_machine
from csplat_bench.common.scenes import NPM, ROOT, Scene
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import EncoderInput, all_inputs
from csplat_conformance.manifest import select_names
from csplat_render.scorer import Scorer
from csplat_tools.console import note
from csplat_tools.views import comparison_cameras

FIGURES = ROOT / "conformance" / "csplat_conformance" / "encoders" / "figures.json"
PRESETS = ("fast", "balanced", "small")
_SHOWN = "balanced"  # preset of our encoder that the table compares with others
_DIGITS = 2  # decimals of values in dB

Figures = dict[str, float | int | None]


@dataclass(frozen=True)
class Measured:
    """The files made of an input.

    Attributes:
        ours: figures by preset; empty if csplat refuses the input.
        spz: figures of the SPZ; `None` if there is no file.
    """

    ours: dict[str, Figures]
    spz: Figures | None


def main(
    *,
    scenes: Annotated[str, typer.Option(help="patterns of names, separated by commas")] = "*",
    write: Annotated[bool, typer.Option("--write", help="write the suite's figures.json, of all inputs")] = False,
    markdown: MARKDOWN = False,
    peers: PEERS = NPM,
) -> None:
    """Measure the inputs that the command line names, and print a table, or write the figures."""
    command, remark = find_splat_transform(peers)
    if command is None and write:
        raise InputError(f"without SPZ there are no figures: {remark}")
    tell_machine(SPZ=remark)
    names = select_names("*" if write else scenes, [one.name for one in all_inputs()], "input")
    wanted = {one.name: one for one in all_inputs() if one.name in names and not one.must_refuse}
    measured = {}
    for name, one in wanted.items():
        if one.renders or write:
            measured[name] = _measure(one, command)
            note(name)
    if write:
        lines = [f"{json.dumps(name)}: {json.dumps(figures)}" for name, figures in _figures(measured).items()]
        FIGURES.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")
        note(f"wrote {FIGURES}")
        return
    columns = ("wanted", *PRESETS, "SPZ")
    rows = [(name, f"{wanted[name].psnr_min:g}", *_cells(found)) for name, found in measured.items()]
    print(table(("input, dB", *columns), rows, markdown=markdown))


def _measure(one: EncoderInput, command: list[str] | None) -> Measured:
    with TemporaryDirectory(prefix="csplat-inputs-") as folder:
        path = Path(folder) / f"{one.name.replace('/', '-')}.ply"
        path.write_bytes(one.make())
        assert one.source is not None, "it can be encoded"
        source = one.source()
        try:
            ours = {preset: _ours(one, source, path, preset) for preset in PRESETS}
        except InputError:
            ours = {}
        spz = None
        if command is not None and source.sh_degree <= MAX_SH_DEGREE:
            write_ply(path, source.to_model((0.0, 0.0, 0.0)))
            spz = _spz(one, source, path, command)
    return Measured(ours, spz)


def _ours(one: EncoderInput, source: Source, path: Path, preset: str) -> Figures:
    data = encode(read_ply(path), EncodeOptions(preset=preset_of(preset)))
    decoded = decode(data)
    return {"bytes": len(data), "psnr": _judge(source.to_model(decoded.origin)).psnr(decoded) if one.renders else None}


def _spz(one: EncoderInput, source: Source, path: Path, command: list[str]) -> Figures | None:
    scene = Scene(path.stem, path, len(source), source.sh_degree)
    peer = transform(command, scene, path.parent)[0]
    if peer.timing is None:
        return None
    if not one.renders:
        return {"bytes": peer.size_bytes, "psnr": None}
    psnr = judged(command, peer, _judge(source.to_model(_origin(source))))
    return None if isinstance(psnr, str) else {"bytes": peer.size_bytes, "psnr": psnr}


def _judge(source: SplatModel) -> Scorer:
    return Scorer.of_source(source, comparison_cameras(source))


def _origin(source: Source) -> tuple[float, float, float]:
    """Whole numbers near a far scene, where binary32 is fine; else zero."""
    x, y, z = np.round(np.median(source.means, axis=0)).tolist() if source.means.dtype == np.float64 else (0.0,) * 3
    return x, y, z


def _figures(measured: dict[str, Measured]) -> dict[str, Any]:
    def rounded(figures: Figures) -> Figures:
        return {key: round(value, _DIGITS) if isinstance(value, float) else value for key, value in figures.items()}

    result = {}
    for name, found in measured.items():
        parts = {"csplat": found.ours.get(_SHOWN), "spz": found.spz}
        if any(parts.values()):
            result[name] = {key: rounded(figures) for key, figures in parts.items() if figures is not None}
    return result


def _cells(found: Measured) -> list[str]:
    decibels = [found.ours[preset]["psnr"] if found.ours else None for preset in PRESETS]
    decibels.append(None if found.spz is None else found.spz["psnr"])
    return ["" if one is None else f"{one:.1f}" for one in decibels]


if __name__ == "__main__":
    sys.exit(run(main))
