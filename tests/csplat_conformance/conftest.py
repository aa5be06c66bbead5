# SPDX-License-Identifier: Apache-2.0
"""Our file of the plain input, and the suite over it with altered statements."""

from dataclasses import replace
from pathlib import Path

import pytest
from encoder_runs_cases import INPUTS, L3, PLAIN, model_of

import csplat
from csplat.decoder import decode_scene
from csplat.encode_api import encode_with_report
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder
from csplat_conformance.protocol import ProcessEnd


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The plain input, after reading."""
    return model_of(PLAIN, tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def encoded(plain):
    """The plain input, encoded by our encoder, and its source index."""
    result = encode_with_report(plain)
    return result.data, result.source_index


@pytest.fixture
def altered(monkeypatch, plain):
    """Run the suite over our file with altered statements."""
    data = csplat.encode(plain)

    def run(_command, places, _seconds):
        Path(places["out"]).write_bytes(data)
        return ProcessEnd(None, 0, b"", b"", 0.0)

    def report(change, levels=L3, render_score=None, name=PLAIN, **fields):
        one = replace(INPUTS[name], **fields)
        monkeypatch.setattr(
            "csplat_conformance.encoders.file_checks.decode_scene", lambda data: change(decode_scene(data))
        )
        monkeypatch.setattr("csplat_conformance.encoders.encoder_suite.all_inputs", lambda: [one])
        return run_encoder("x {ply} {out}", EncoderSuiteOptions(name, levels), run=run, render_score=render_score,
            no_render_reason="no renderer")  # fmt: skip

    return report
