# SPDX-License-Identifier: Apache-2.0
"""The reference inputs of the encoder conformance suite: bytes and quality of csplat's presets and of SPZ.

A scene is the name of an input, or a pattern of names. A case has a `preset`, or `peer = "spz"`. SPZ is written and
read by splat-transform from a plain PLY of the same splats: the format is measured, not the PLY reader.
`python -m csplat_bench figures RESULT.json` writes the suite's figures.json.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from csplat.decoder import decode
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply
from csplat_bench.peers import read_peer, write_peer
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import ROOT
from csplat_bench.suites import Case
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import EncoderInput, all_inputs
from csplat_conformance.manifest import select_names
from csplat_render.scorer import Scorer
from csplat_tools.views import comparison_cameras

FIGURES = ROOT / "conformance" / "csplat_conformance" / "encoders" / "figures.json"
_SHOWN = {"balanced": "csplat", "SPZ": "spz"}  # names in figures.json, by case
_DIGITS = 2  # decimals of PSNR in figures.json
_PEER_DEGREE = 3  # highest SH degree of splat-transform 3


def input_names(_: Setup, patterns: Sequence[str]) -> list[str]:
    """Return the inputs that can be encoded and match a pattern."""
    encodable = [one.name for one in all_inputs() if one.source is not None and not one.must_refuse]
    chosen = select_names(",".join(patterns), [one.name for one in all_inputs()], "input")
    return [name for name in encodable if name in chosen]


@contextmanager
def measure_input(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that encodes an input and scores the file."""
    one = next(one for one in all_inputs() if one.name == name)
    assert one.source is not None, "it can be encoded"
    source = one.source()
    with TemporaryDirectory(prefix="csplat-inputs-") as folder:
        path = Path(folder) / f"{name.replace('/', '-')}.ply"
        path.write_bytes(one.make())

        def measure(case: Case) -> Mapping[str, Any]:
            return {
                "psnr_required": one.psnr_min,
                **(_spz(one, source, path, setup.peers) if "peer" in case.settings else _ours(one, source, path, case)),
            }

        yield measure


def write_figures(rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write figures.json of the encoder suite.

    Raises:
        InputError: a row of csplat's is missing, or no SPZ was measured.
    """
    figures: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["case"] in _SHOWN and row.get("size_bytes") is not None:
            psnr = None if row["psnr"] is None else round(row["psnr"], _DIGITS)
            figures.setdefault(row["scene"], {})[_SHOWN[row["case"]]] = {"bytes": row["size_bytes"], "psnr": psnr}
    measured = {row["scene"] for row in rows}
    expected = {one.name for one in all_inputs() if one.source is not None and not one.must_refuse}
    if measured != expected or not any("spz" in one for one in figures.values()):
        raise InputError("the results lack inputs or SPZ, expected those of `run encoder_inputs` with splat-transform")
    lines = [f"{json.dumps(one.name)}: {json.dumps(figures[one.name])}" for one in all_inputs() if one.name in figures]
    FIGURES.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")
    return FIGURES


def _ours(one: EncoderInput, source: Source, path: Path, case: Case) -> dict[str, Any]:
    try:
        data = encode(read_ply(path), EncodeOptions(preset=case["preset"]))
    except InputError as error:  # csplat refuses the input, which the suite allows
        return {"size_bytes": None, "psnr": None, "refused": str(error)}
    decoded = decode(data)
    psnr = _scorer(source.to_model(decoded.origin)).psnr(decoded) if one.renders else None
    return {"size_bytes": len(data), "psnr": psnr}


def _spz(one: EncoderInput, source: Source, path: Path, peers: Path) -> dict[str, Any]:
    if source.sh_degree > _PEER_DEGREE:
        raise AbsentError(f"splat-transform does not write SPZ of SH degree {source.sh_degree}")
    plain, file = path.with_name("plain.ply"), path.with_suffix(".spz")
    write_ply(plain, source.to_model((0.0, 0.0, 0.0)))
    write_peer("spz", plain, len(source), source.sh_degree, file, peers)
    psnr = _scorer(source.to_model(_origin(source))).psnr(read_peer(file, peers)) if one.renders else None
    return {"size_bytes": file.stat().st_size, "psnr": psnr}


def _scorer(source: SplatModel) -> Scorer:
    return Scorer.of_source(source, comparison_cameras(source))


def _origin(source: Source) -> tuple[float, float, float]:
    """Return whole numbers near a distant scene, where float32 has a fine grid, else zero."""
    x, y, z = np.round(np.median(source.means, axis=0)).tolist() if source.means.dtype == np.float64 else (0.0,) * 3
    return x, y, z
