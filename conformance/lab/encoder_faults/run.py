# SPDX-License-Identifier: CC0-1.0
"""Run our encoder with a planted fault, and the conformance suite on it."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
import tempfile
import time
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import numpy as np

import csplat
from csplat import ply as ply_files
from csplat.context import Context
from csplat.encode_api import encode_planned, encode_with_report
from csplat.encoder import EncodePlan, Origin
from csplat.errors import CsplatError
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status
from csplat_conformance.encoders import LEVELS, EncoderSuiteOptions, all_inputs, run_encoder
from csplat_conformance.protocol import ProcessEnd
from encoder_faults import behaviour, encoding, reading
from encoder_faults.fault import EncoderFault, true_errors

#: All faults by module, in the order of the encoder.
GROUPS = {"reading": reading.FAULTS, "encoding": encoding.FAULTS, "behaviour": behaviour.FAULTS}
FAULTS = {name: fault for group in GROUPS.values() for name, fault in group.items()}
assert len(FAULTS) == sum(map(len, GROUPS.values())), "two faults have one name"


def encode(fault, ply, out, index=None):
    """Encode a PLY with a fault.

    Args:
        fault: the fault.
        ply, out: paths of input and output.
        index: path for the source index, if requested.
    """
    with np.errstate(all="ignore"):  # a faulty encoder may divide by zero
        data, source_index = _encoded(fault, ply)
    if fault.honest is not None:
        data = encoding.bounded(true_errors(fault.honest(ply), csplat.decode(data), source_index))(data)
    if fault.data is not None:
        data = fault.data(data)
    if fault.end is None:
        out.write_bytes(data)
    else:
        fault.end(ply, out, data)
    if index is not None:
        with Path(index).open("wb") as stream:
            np.save(stream, source_index if fault.index is None else fault.index(source_index))


def _encoded(fault, ply):
    """Return the encoded file and its source index."""
    if fault.is_late:
        return honest(ply.read_bytes(), tuple(fault.options.items()))
    with fault.stage():
        model = _read_input(fault, ply)
        if fault.scene is not None:
            model = fault.scene(model)
        origin = None
        if fault.keep is not None:
            rows = fault.keep(model).astype(np.int64)
            model, origin = model.select(rows), Origin(len(model), rows)
        context = Context(threads=1)  # stages patch modules, which is not safe with several threads
        options = csplat.EncodeOptions(**fault.options)
        result = encode_planned(EncodePlan.of(model, options, origin=origin, context=context))
    return result.data, result.source_index


@cache
def honest(content, options=()):
    """Encode a PLY without a fault; return the file and its source index.

    Args:
        content: the PLY.
        options: options of the encoder, (name, value) pairs.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-honest-") as folder:
        path = Path(folder) / "in.ply"
        path.write_bytes(content)
        model = ply_files.read_ply(path, keep_extra=bool(dict(options).get("keep_extra")))
    result = encode_with_report(model, csplat.EncodeOptions(**dict(options)))
    return result.data, result.source_index


def _read_input(fault, ply):
    keep_extra = bool(fault.options.get("keep_extra"))
    if fault.ply is None:
        return ply_files.read_ply(ply, keep_extra=keep_extra)
    with tempfile.TemporaryDirectory(prefix="csplat-wrong-") as folder:
        path = Path(folder) / "in.ply"
        path.write_bytes(fault.ply(ply.read_bytes()))
        return ply_files.read_ply(path, keep_extra=keep_extra)


PLACES = "{ply} {out} {index}"
#: Statuses that are not failures but report a defect.
SIGNS = (Status.WARNED, Status.NOT_PROVED)


def command_of(name: str) -> str:
    """Return the command line that starts a faulty encoder."""
    return f"{shlex.quote(sys.executable)} -m encoder_faults {name} {PLACES}"


def inputs_of(fault: EncoderFault) -> list[str]:
    """Return the names of the reference inputs that reveal a fault."""
    patterns = fault.inputs.split(",")
    return [one.name for one in all_inputs() if any(fnmatch(one.name, pattern) for pattern in patterns)]


def find(name: str, *, names: list[str] | None = None, levels: tuple[str, ...] | None = None) -> ConformanceReport:
    """Run the conformance suite on a faulty encoder.

    Args:
        name: name of the fault.
        names: names of the inputs; default: the fault's own.
        levels: levels to check; default: all except renders, which are included only if the fault is caught there.
    """
    fault = FAULTS[name]
    names = inputs_of(fault) if names is None else names
    if not names:
        return ConformanceReport("encoder", name, [], ("there is no such input",))
    if levels is None:
        levels = LEVELS if fault.caught[0] == LEVELS[-1] else LEVELS[:-1]
    choice = EncoderSuiteOptions(",".join(names), levels, 4.0 if name == "hangs" else 60.0, jobs=1)
    render_score = psnr if LEVELS[-1] in levels else None
    return run_encoder(command_of(name), choice, render_score=render_score, run=None if fault.starts else run_here)


def first_sign(report: ConformanceReport):
    """Return the first outcome that reports a defect, or `None`."""
    signs = report.failures or [one for one in report.outcomes if one.status in SIGNS]
    signs += [Outcome("", "L1", Status.WARNED, message=note) for note in report.notes if note.startswith("warning: ")]
    return signs[0] if signs else None


def run_here(command, places, _seconds):
    """Run a command line of `command_of` in this process."""
    began = time.perf_counter()
    index = places.get("index")
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = status_of(shlex.split(command)[3], places["ply"], places["out"], index)
    status, message = (Status.WRONG_STATUS, f"exit status {code}") if code > 1 else (None, "")
    seconds = time.perf_counter() - began
    return ProcessEnd(status, code, out.getvalue().encode(), err.getvalue().encode(), seconds, message)


def status_of(name, ply, out, index=None):
    """Encode and return the exit status."""
    try:
        encode(FAULTS[name], Path(ply), Path(out), index)
    except SystemExit as ended:
        if not isinstance(ended.code, str):
            return ended.code or 0
        sys.stderr.write(ended.code + "\n")
        return 1
    except CsplatError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


#: Number of views, and their width and height in pixels.
VIEWS = (8, 160, 120)


def psnr(source, decoded):
    """Return the PSNR of small renders. The scorer of each source is cached."""
    key = b"".join(
        values.tobytes()
        for values in (source.means, source.quats, source.scales, source.opacities, source.sh0, source.shN)
    )
    scorer = _scorers.get(key)
    if scorer is None:
        from csplat_render.scorer import Scorer
        from csplat_render.virtual_cameras import virtual_cameras

        scorer = _scorers[key] = Scorer.of_source(source, virtual_cameras(source, *VIEWS, seed=0))
    return scorer.psnr(decoded)


_scorers = {}
