# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of encoder runs, which several files share."""

import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import csplat
from csplat.decoder import decode_scene
from csplat_conformance.encoders import EncoderSuiteOptions, all_inputs, run_encoder
from csplat_conformance.encoders.error_checks import check_errors
from csplat_conformance.encoders.file_checks import check_content
from csplat_conformance.protocol import ProcessEnd

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
COMMAND = "encoder {ply} {out} {index}"
PLAIN = "ordinary/degree_1"
FILES = EncoderSuiteOptions(PLAIN, ("L1",), jobs=1)
L3 = ("L1", "L2", "L3")
MAPS = EncoderSuiteOptions(PLAIN, ("L2",), jobs=1)


def program(code):
    """Return a command line that runs Python code on {ply} and {out}; the standard library alone starts quickly."""
    return f"{shlex.quote(sys.executable)} -I -S -c {shlex.quote(code)} {{ply}} {{out}}"


def running(encoded, change):
    """Return an encoder in this process: our own, then `change` on the paths `ply`, `out` and `index`."""

    def run(_command, places, _seconds):
        at = SimpleNamespace(**{name: Path(place) for name, place in places.items()})
        at.out.write_bytes(encoded[0])
        np.save(at.index, encoded[1])
        code = change(at) or 0
        return ProcessEnd(None, code, b"", b"error: no" if code else b"", 0.0)

    return run


def first(report):
    outcome = report.outcomes[0]
    return outcome.status, outcome.clauses, outcome.message


def outcome_of(encoded, change, choice=FILES):
    """Return status, clauses and message of our own encoder followed by `change`."""
    return first(run_encoder(COMMAND, choice, run=running(encoded, change)))


def refuse(at):
    at.out.unlink()
    return 1


def model_of(name, folder):
    (folder / "in.ply").write_bytes(INPUTS[name].make())
    return csplat.read(folder / "in.ply")


def judged(name, model, change=lambda scene: scene, **options):
    """L2 and L3 of our encoder's file, and the reasons why only pictures can judge the rest."""
    scene = change(decode_scene(csplat.encode(model, csplat.EncodeOptions(**options))))
    content, pairs = check_content(INPUTS[name], INPUTS[name].source(), scene, None)
    return content, *check_errors(INPUTS[name], scene, pairs)
