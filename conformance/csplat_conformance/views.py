"""L4: renderings. A scene, a camera, a reference picture, and how near to it a renderer has to come.

The picture is what the equations give in binary64 (`csplat_render.reference_rasteriser`), over black, clipped to 0..1,
times 255 and rounded; IMPLEMENTERS.md lists the conventions. A renderer is a command

    my-renderer INPUT CAMERA OUT

INPUT is a `.csplat` file, CAMERA a JSON file that holds a list of one camera, OUT the PNG to write; with `{outdir}`
in place of `{out}` any one PNG in that folder.
"""

from __future__ import annotations

import importlib.util
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.types import U8
from csplat_conformance.manifest import VECTORS, Vector
from csplat_conformance.pictures import psnr, read_png
from csplat_conformance.process import run_program
from csplat_conformance.protocol import last_words
from csplat_conformance.report import Outcome, Status

_LEVEL = "L4"


def can_render() -> bool:
    """Return True if csplat's renderer can be imported (the extra `render`)."""
    return importlib.util.find_spec("numba") is not None


def quantised(rgb: NDArray[Any]) -> U8:
    """Return a picture's 8-bit values: clipped to 0..1, times 255, rounded."""
    picture: U8 = np.rint(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    return picture


def reference_picture(floats: Mapping[str, NDArray[Any]], camera: Mapping[str, Any], antialiased: bool) -> U8:
    """Render the expected arrays of a scene from the equations, in binary64. Needs the extra `render`."""
    from csplat_render.camera import Camera  # in the extra `render`, which the suite can do without
    from csplat_render.reference_rasteriser import render_exact

    splats: Any = SimpleNamespace(**floats)
    return quantised(render_exact(splats, Camera.from_json(camera), antialiased=antialiased).rgb)


def judge_ours(vector: Vector) -> list[Outcome]:
    """Render a vector's views with csplat's decoder and rasteriser."""
    from csplat.decoder import decode
    from csplat_render import render
    from csplat_render.camera import Camera

    model = decode(vector.data)
    result = []
    for number, view in enumerate(vector.views):
        picture = quantised(render(model, Camera.from_json(view["camera"])).rgb)
        result.append(_scored(vector, number, picture, 0.0))
    return result


def judge_command(vector: Vector, command: str, timeout: float) -> list[Outcome]:
    """Render a vector's views with the command of another renderer.

    Args:
        vector: with views.
        command: command line with `{input}`, `{camera}` and `{out}` or `{outdir}`.
        timeout: seconds for each picture.
    """
    return [_judge_view(vector, number, command, timeout) for number in range(len(vector.views))]


def skipped_views(vector: Vector, why: str) -> list[Outcome]:
    """Return outcomes that say why nothing was rendered."""
    return [_outcome(vector, number, Status.SKIPPED, why) for number in range(len(vector.views))]


def _judge_view(vector: Vector, number: int, command: str, timeout: float) -> Outcome:
    with tempfile.TemporaryDirectory(prefix="csplat-conformance-") as name:
        folder = Path(name)
        outdir, camera = folder / "out", folder / "camera.json"
        outdir.mkdir()
        camera.write_text(json.dumps([vector.views[number]["camera"]]), encoding="utf-8")
        out = {"outdir": outdir} if "{outdir}" in command else {"out": outdir / "0.png"}
        places = {"input": VECTORS / vector.file, "camera": camera, **out}
        ended = run_program(command, {key: str(path) for key, path in places.items()}, timeout)
        seconds = ended.seconds
        if ended.status is not None:
            return _outcome(vector, number, ended.status, ended.message + last_words(ended), seconds)
        if ended.returncode:
            return _outcome(vector, number, Status.REFUSED, f"exit status 1{last_words(ended)}", seconds)
        found = sorted(outdir.rglob("*.png"))
        if len(found) != 1:
            wrong = Status.WRONG_ANSWER if found else Status.NO_OUTPUT
            return _outcome(vector, number, wrong, f"{len(found)} PNG files were written, wanted one", seconds)
        try:
            return _scored(vector, number, read_png(found[0].read_bytes()), seconds)
        except InputError as error:
            return _outcome(vector, number, Status.WRONG_ANSWER, str(error), seconds)


def _scored(vector: Vector, number: int, picture: U8, seconds: float) -> Outcome:
    view = vector.views[number]
    found = psnr(read_png((VECTORS / view["picture"]).read_bytes()), picture)
    passed = found >= view["psnr"]
    message = "" if passed else f"{found:.1f} dB against {view['picture']}, wanted {view['psnr']:g}"
    status = Status.PASSED if passed else Status.FAILED
    return _outcome(vector, number, status, message, seconds, psnr=round(found, 2))


def _outcome(
    vector: Vector, number: int, status: Status, message: str, seconds: float = 0.0, **details: Any
) -> Outcome:
    name = f"{vector.name}#{number}"
    return Outcome(name, _LEVEL, status, tuple(vector.clauses), "", message, seconds, details)
