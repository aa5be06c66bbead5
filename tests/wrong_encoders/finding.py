"""Run the conformance suite on a wrong encoder."""

import contextlib
import io
import shlex
import sys
import time
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from csplat.errors import CsplatError
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status
from csplat_conformance.encoders import LEVELS, EncoderSuiteOptions, all_inputs, run_encoder
from csplat_conformance.protocol import ProcessEnd
from wrong_encoders.encoding import encode
from wrong_encoders.mistake import Mistake
from wrong_encoders.mistakes import MISTAKES

FOLDER = Path(__file__).parent
PLACES = "{ply} {out} {index}"
#: Statuses that are no failures and say something all the same.
SIGNS = (Status.WARNED, Status.NOT_PROVED)


def command_of(name: str) -> str:
    """The command line that starts a wrong encoder."""
    return f"{shlex.quote(sys.executable)} {shlex.quote(str(FOLDER))} {name} {PLACES}"


def inputs_of(mistake: Mistake) -> list[str]:
    """Names of the reference inputs that show a mistake; none if there is no such input."""
    patterns = mistake.inputs.split(",")
    return [one.name for one in all_inputs() if any(fnmatch(one.name, pattern) for pattern in patterns)]


def find(name: str, *, names: list[str] | None = None, levels: tuple[str, ...] | None = None) -> ConformanceReport:
    """Run the conformance suite over a mistake; return its report.

    Args:
        name: name of the mistake.
        names: names of the inputs; default: the mistake's own.
        levels: levels to check; default: all but renders, which are added if nothing else shows the mistake.
    """
    mistake = MISTAKES[name]
    names = inputs_of(mistake) if names is None else names
    if not names:
        return ConformanceReport("encoder", name, [], ("there is no such input",))
    if levels is None:
        levels = LEVELS if mistake.caught[0] == LEVELS[-1] else LEVELS[:-1]
    choice = EncoderSuiteOptions(",".join(names), levels, 4.0 if name == "hangs" else 60.0, jobs=1)
    render_score = psnr if LEVELS[-1] in levels else None
    return run_encoder(command_of(name), choice, render_score=render_score, run=None if mistake.starts else run_here)


def first_sign(report: ConformanceReport):
    """Return the first outcome that reports a defect, or `None`."""
    signs = report.failures or [one for one in report.outcomes if one.status in SIGNS]
    signs += [Outcome("", "L1", Status.WARNED, message=note) for note in report.notes if note.startswith("warning: ")]
    return signs[0] if signs else None


def run_here(command, places, _seconds):
    """Encode as `main` does with this command line, in this process."""
    began = time.perf_counter()
    index = places.get("index")
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = status_of(shlex.split(command)[2], places["ply"], places["out"], index)
    status, message = (Status.WRONG_STATUS, f"exit status {code}") if code > 1 else (None, "")
    seconds = time.perf_counter() - began
    return ProcessEnd(status, code, out.getvalue().encode(), err.getvalue().encode(), seconds, message)


def status_of(name, ply, out, index=None):
    """Encode and return the exit status."""
    try:
        encode(MISTAKES[name], Path(ply), Path(out), index)
    except SystemExit as ended:
        if not isinstance(ended.code, str):
            return ended.code or 0
        sys.stderr.write(ended.code + "\n")
        return 1
    except CsplatError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


#: Views of a picture: how many, and pixels.
VIEWS = (8, 160, 120)


def psnr(source, decoded):
    """Return the PSNR of small renders; the judge of a source is made once."""
    key = b"".join(
        values.tobytes()
        for values in (source.means, source.quats, source.scales, source.opacities, source.sh0, source.shN)
    )
    judge = _judges().get(key)
    if judge is None:
        from csplat_render.scorer import Scorer
        from csplat_render.virtual_cameras import virtual_cameras

        judge = _judges()[key] = Scorer.of_source(source, virtual_cameras(source, *VIEWS, seed=0))
    return judge.psnr(decoded)


@cache
def _judges():
    return {}
