"""Measure the reference inputs of the encoder suite: sizes and pictures of ours and of SPZ, and what mistakes do.

    python -m csplat_bench.codec.inputs                         # all that render; two minutes
    python -m csplat_bench.codec.inputs --scenes '*/surfaces,*/glossy' --markdown
    python -m csplat_bench.codec.inputs --write                 # figures.json of the suite, of all that can be encoded

A column of a preset or of SPZ says what its file keeps, in dB of `psnr`; one of a mistake what a scene keeps in which
only that is wrong, exact otherwise. SPZ is written and read by splat-transform, from a plain PLY of the same splats: it
is the format that is measured, not who reads what PLY.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.ply import read_ply, write_ply
from csplat_bench.common.command import MARKDOWN, PEERS, run, tell
from csplat_bench.common.peers import find_splat_transform, judged, transform
from csplat_bench.common.report import table, tell_machine
from csplat_bench.common.scenes import NPM, ROOT, Scene
from csplat_conformance.choosing import matching
from csplat_conformance.encoders import Input, all_inputs
from csplat_conformance.stated import Source
from csplat_render.judge import Judge
from csplat_tools.views import comparison_cameras

FIGURES = ROOT / "conformance" / "csplat_conformance" / "encoders" / "figures.json"
PRESETS = ("fast", "balanced", "small")
_SHOWN = "balanced"  # the preset that the suite shows beside others
_DIGITS = 2  # of dB

Change = Callable[[SplatModel], SplatModel]
Figures = dict[str, float | int | None]


@dataclass(frozen=True)
class Measured:
    """What was made of an input.

    Attributes:
        ours: by preset; none where ours refuses it.
        spz: `None` where there is no file.
        mistakes: dB by mistake; none where it does not render.
    """

    ours: dict[str, Figures]
    spz: Figures | None
    mistakes: dict[str, float]


def main(
    *,
    scenes: Annotated[str, typer.Option(help="patterns of names, separated by commas")] = "*",
    write: Annotated[bool, typer.Option("--write", help="write the suite's figures.json, of all inputs")] = False,
    no_mistakes: Annotated[bool, typer.Option("--no-mistakes", help="leave mistakes out")] = False,
    markdown: MARKDOWN = False,
    peers: PEERS = NPM,
) -> None:
    """Measure the inputs that the command line names, and print a table, or write the figures."""
    command, remark = find_splat_transform(peers)
    if command is None and write:
        raise InputError(f"without SPZ there are no figures: {remark}")
    tell_machine(SPZ=remark)
    names = matching("*" if write else scenes, [one.name for one in all_inputs()], "input")
    wanted = {one.name: one for one in all_inputs() if one.name in names and not one.must_refuse}
    measured = {}
    for name, one in wanted.items():
        if one.renders or write:
            measured[name] = _measure(one, command, mistakes=not (write or no_mistakes))
            tell(name)
    if write:
        lines = [f"{json.dumps(name)}: {json.dumps(figures)}" for name, figures in _figures(measured).items()]
        FIGURES.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")
        tell(f"wrote {FIGURES}")
        return
    columns = ("wanted", *PRESETS, "SPZ", *({} if no_mistakes else MISTAKES))
    rows = [(name, f"{wanted[name].psnr_min:g}", *_cells(found)) for name, found in measured.items()]
    print(table(("input, dB", *columns), rows, markdown=markdown))


def _measure(one: Input, command: list[str] | None, *, mistakes: bool) -> Measured:
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
            write_ply(path, source.model((0.0, 0.0, 0.0)))
            spz = _spz(one, source, path, command)
    found = {}
    if mistakes and one.renders:
        model = source.model(_origin(source))
        judge = _judge(model)
        found = {name: judge.psnr(change(model)) for name, change in MISTAKES.items()}
    return Measured(ours, spz, found)


def _ours(one: Input, source: Source, path: Path, preset: str) -> Figures:
    data = encode(read_ply(path), EncodeOptions(preset=preset))
    decoded = decode(data)
    return {"bytes": len(data), "psnr": _judge(source.model(decoded.origin)).psnr(decoded) if one.renders else None}


def _spz(one: Input, source: Source, path: Path, command: list[str]) -> Figures | None:
    scene = Scene(path.stem, path, len(source), source.sh_degree)
    peer = transform(command, scene, path.parent)[0]
    if peer.timing is None:
        return None
    if not one.renders:
        return {"bytes": peer.size_bytes, "psnr": None}
    psnr = judged(command, peer, _judge(source.model(_origin(source))))
    return None if isinstance(psnr, str) else {"bytes": peer.size_bytes, "psnr": psnr}


def _judge(source: SplatModel) -> Judge:
    return Judge.of_source(source, comparison_cameras(source))


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
    decibels += [None if found.spz is None else found.spz["psnr"], *found.mistakes.values()]
    return ["" if one is None else f"{one:.1f}" for one in decibels]


# Mistakes ------------------------------------------------------------------------------------------


def _changed(**arrays: Callable[[SplatModel], NDArray[Any]]) -> Change:
    def change(model: SplatModel) -> SplatModel:
        made: dict[str, Any] = {name: np.ascontiguousarray(make(model), "<f4") for name, make in arrays.items()}
        return replace(model, **made)

    return change


def _clipped_gauge(model: SplatModel) -> NDArray[Any]:
    """Clip x, y, z to what they are where w is the largest, and take w from the rest."""
    quats = model.quats.astype(np.float64) * np.where(model.quats[:, :1] < 0.0, -1.0, 1.0)
    vector = np.clip(quats[:, 1:], -np.sqrt(0.5), np.sqrt(0.5))
    squares = np.square(vector).sum(axis=1, keepdims=True)
    vector /= np.sqrt(np.maximum(squares, 1.0))
    return np.concatenate([np.sqrt(np.maximum(0.0, 1.0 - squares)), vector], axis=1)


def _logits(model: SplatModel) -> NDArray[Any]:
    alpha = np.clip(model.opacities.astype(np.float64), 1e-7, 1.0 - 1e-7)
    return np.log(alpha / (1.0 - alpha))


def _logistic(values: NDArray[Any]) -> NDArray[Any]:
    return 1.0 / (1.0 + np.exp(-values.astype(np.float64)))


MISTAKES: dict[str, Change] = {
    "w without sign": _changed(quats=lambda m: m.quats * np.where(m.quats < 0.0, (-1, 1, 1, 1), 1)),
    "conjugate": _changed(quats=lambda m: m.quats * (1, -1, -1, -1)),
    "x y z w": _changed(quats=lambda m: np.roll(m.quats, 1, axis=1)),
    "gauge clipped": _changed(quats=_clipped_gauge),
    "scales cut at 0.2": _changed(scales=lambda m: np.floor(m.scales / 0.2) * 0.2),
    "sigmoid twice": _changed(opacities=lambda m: _logistic(m.opacities)),
    "logit as alpha": _changed(opacities=lambda m: np.clip(_logits(m), 0.0, 1.0)),
    "16 alphas": _changed(opacities=lambda m: np.round(m.opacities * 15.0) / 15.0),
    "sh0 in ±1": _changed(sh0=lambda m: np.clip(m.sh0, -1.0, 1.0)),
    "SH in ±1": _changed(shN=lambda m: np.clip(m.shN, -1.0, 1.0)),
    "SH of degree 1": _changed(shN=lambda m: m.shN[:, :3]),
    "band 1 negated": _changed(shN=lambda m: np.concatenate([-m.shN[:, :3], m.shN[:, 3:]], axis=1)),
    "means in float16": _changed(means=lambda m: np.clip(m.means, -65504, 65504).astype(np.float16)),
}


if __name__ == "__main__":
    sys.exit(run(main))
