"""The JavaScript decoder in a long-lived Node process, asked file after file."""

from __future__ import annotations

import json
import os
import shutil
import struct
import time
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat_conformance.answers import Answer, whole_number
from csplat_conformance.report import Status
from csplat_conformance.serving import Served

_ADAPTER = Path("test", "adapter.mjs")
_HEAP_MB = 512


def js_folder() -> Path:
    """Return the folder of the JavaScript decoder, whose tests hold the adapter: only a checkout has them.

    Raises:
        InputError: neither this package nor the working folder belongs to a checkout.
    """
    for root in (Path(__file__).parents[2], Path.cwd()):
        folder = root / "codec" / "js"
        if (folder / _ADAPTER).is_file():
            return folder
    raise InputError("the JavaScript decoder is not here: only a checkout has it and its adapter")


def missing_javascript() -> str:
    """Return why the JavaScript decoder cannot run here, or an empty string."""
    if shutil.which("node") is None:
        return "node is not installed"
    try:
        js_folder()
    except InputError as error:
        return str(error)
    return ""


class JsDecoder(Served):
    """A Node process that decodes what it is sent.

    Args:
        folder: folder of the decoder's modules, a copy that may have been changed; None for the checkout's.
        limits: budgets, by their names in JavaScript; the registry's if left out.
        timeout: seconds for one file.
        coverage: folder to which Node writes its coverage when it ends.
    """

    def __init__(
        self,
        folder: Path | None = None,
        limits: dict[str, int] | None = None,
        timeout: float = 20.0,
        coverage: Path | None = None,
    ) -> None:
        missing = missing_javascript()
        if missing:
            raise InputError(missing)
        home = js_folder()
        options = {"limits": limits} if limits else {}
        node = shutil.which("node") or "node"
        words = [node, f"--max-old-space-size={_HEAP_MB}", str(home / _ADAPTER), "--serve", json.dumps(options)]
        environment = os.environ | {"CSPLAT_JS": str(folder or home)}
        if coverage is not None:
            environment["NODE_V8_COVERAGE"] = str(coverage)
        super().__init__(words, timeout, environment)

    def ask(self, data: bytes) -> Answer:
        """Decode one file, as floats and as integers."""
        began = time.monotonic()
        line = self._answered(struct.pack("<I", len(data)) + data)
        if isinstance(line, Answer):
            return line
        return _answer(json.loads(line, parse_int=whole_number), time.monotonic() - began)


def _answer(found: dict[str, Any], seconds: float) -> Answer:
    if "defect" in found:
        return Answer(Status.CRASHED, " | ".join(found["defect"].splitlines()[:3]), seconds=seconds)
    if "code" in found:
        code, clause, offset = found["code"], found.get("clause"), found.get("offset")
        return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=seconds)
    arrays = {key: (size, digest) for key, (size, digest) in found["arrays"].items()}
    return Answer(Status.PASSED, "", found["header"], arrays, seconds=seconds)
