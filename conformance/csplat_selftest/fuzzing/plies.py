"""The PLY reader under malformed files: headers and bodies damaged with an eye for their structure."""

from __future__ import annotations

import math
import random
import tempfile
import warnings
import zlib
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path

import numpy as np

import csplat
from csplat.errors import InputError
from csplat.model import QUAT_LENGTH_TOLERANCE, SplatModel
from csplat.ply import lint_ply, read_ply, write_ply
from csplat_selftest.fuzzing import ply_mutants
from csplat_selftest.fuzzing.ply_mutants import Ply, changed
from csplat_selftest.fuzzing.targets import Case

_PACKAGE = Path(csplat.__file__).parent


class FileTarget:
    """A base of targets that read files from a folder of their own, within this process."""

    def __init__(self) -> None:
        memory = Path("/dev/shm")  # noqa: S108 - a folder of our own is made in it; a disk costs most of the time
        self._folder = tempfile.TemporaryDirectory(prefix="csplat-fuzz-", dir=memory if memory.is_dir() else None)

    def memory(self) -> str:
        """No limit that another process could pass."""
        return ""

    def coverage(self) -> str:
        """None of another process."""
        return ""

    def close(self) -> None:
        """Remove the scratch folder."""
        self._folder.cleanup()


class PlyTarget(FileTarget):
    """`read_ply` and `lint_ply`: a sound model or an InputError, and the two agree."""

    name = "ply"
    suffix = ".ply"
    watched: Sequence[Path] = tuple(sorted([*_PACKAGE.glob("ply*.py"), _PACKAGE / "lint.py", _PACKAGE / "detect.py"]))

    def __init__(self) -> None:
        super().__init__()
        self._file = Path(self._folder.name) / "case.ply"

    def seeds(self, paths: Iterable[Path]) -> list[Ply]:
        """Return small PLYs of all degrees, encodings and oddities, and the given files."""
        return ply_mutants.seeds() + [Ply.parse(path.read_bytes()) for path in paths]

    def mutant(self, rng: random.Random, corpus: Sequence[Ply]) -> Case:
        """Damage header, body or both."""
        ply = changed(rng, rng.choice(corpus))
        data = ply.data
        if rng.random() < 0.05:
            data = data[: rng.randrange(len(data) + 1)]
        return Case(data, lambda: ply)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Read and lint a file; now and then strictly, with extra columns, and written again."""
        self._file.write_bytes(data)
        chance = zlib.crc32(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            errors = _linted(self._file)
            try:
                model = read_ply(self._file, keep_extra=chance % 4 == 0)
            except InputError as error:
                if errors == [] and "csplat" not in str(error):
                    return "finding", f"lint finds nothing wrong, read_ply refuses: {error}"
                return "refused", ""
            if errors:
                return "finding", f"read_ply accepts what lint calls {errors[0]}"
            wrong = unsound(model)
            if not wrong and chance % 8 == 1:
                wrong = self._written(model)
        return ("finding", wrong) if wrong else ("read", "")

    def _written(self, model: SplatModel) -> str:
        """Write a model and read it again."""
        path = self._file.with_name("again.ply")
        try:
            write_ply(path, model)
            again = read_ply(path, strict=True)
        except InputError as error:
            # Names of extra columns that no PLY can hold.
            return "" if model.extra else f"what was read cannot be written and read: {error}"
        if model.extra:
            return ""
        for name in ("means", "scales", "sh0", "shN"):
            if not np.array_equal(getattr(model, name), getattr(again, name)):
                return f"{name} differ after writing and reading"
        return "" if again.origin == model.origin else "the origin differs after writing and reading"

    def smaller(self, data: bytes, corpus: Sequence[Ply]) -> Generator[bytes, bytes | None, None]:  # noqa: ARG002 - as all targets
        """Leave out lines of the header and pieces of the body."""
        ply = Ply.parse(data)
        for k in reversed(range(len(ply.lines))):
            smaller = Ply(ply.lines[:k] + ply.lines[k + 1 :], ply.body, ply.newline)
            ply = ply if (yield smaller.data) is None else smaller
        piece = len(ply.body)
        while piece := piece // 2:
            for start in reversed(range(0, len(ply.body), piece)):
                smaller = Ply(ply.lines, ply.body[:start] + ply.body[start + piece :], ply.newline)
                ply = ply if (yield smaller.data) is None else smaller


# What must hold ------------------------------------------------------------------------------------


def _linted(path: Path) -> list[str] | None:
    """Return ids of the errors that lint finds, None if it refuses to look."""
    try:
        return [finding.id for finding in lint_ply(path) if finding.kind == "error"]
    except InputError:
        return None


def unsound(model: SplatModel) -> str:
    """Return what is wrong with a model that was read; an empty string if nothing is."""
    arrays = {name: getattr(model, name) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    for name, array in arrays.items():
        if array.dtype != np.float32 or len(array) != len(model.means):
            return f"{name} is {array.dtype} {array.shape}"
        if not np.isfinite(array).all():
            return f"{name} holds NaN or infinity"
    lengths = np.linalg.norm(model.quats.astype(np.float64), axis=1)
    if len(lengths) and np.abs(lengths - 1.0).max() > QUAT_LENGTH_TOLERANCE:
        return "a rotation is not of unit length"
    if not ((model.opacities >= 0) & (model.opacities <= 1)).all():
        return "an opacity is outside 0 to 1"
    return "" if all(map(math.isfinite, model.origin)) else "the origin is not finite"
