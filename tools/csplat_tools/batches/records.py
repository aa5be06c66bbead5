"""`batch.jsonl`: a line for each scene that ended, and for each run that began.

A line is written at once, so that whoever ends the program leaves whole lines behind, but perhaps the last. When a run
ends by itself one line for each scene is left.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from csplat.errors import InputError
from csplat.system import locked_folder
from csplat_tools.files.streams import write_bytes

__all__ = ["JOURNAL", "Journal", "Record", "open_journal", "read_journal"]

JOURNAL = "batch.jsonl"
_LOCK = ".batch.lock"  # on Windows
_BEGUN = "begun"


@dataclass(frozen=True)
class Record:
    """What became of a scene.

    Attributes:
        path: of the source, or its URL.
        output: within the folder of outputs, or a URL.
        command: with its options, as words.
        version: of the program.
        state: `done` or `failed`.
        sha256: of the source's content; "" where it could not be read.
        code: of the error, `E_INPUT`, or `ENOENT`; "" where there is none.
        error: what went wrong, one line.
        source_bytes, output_bytes: of the files.
        output_sha256: of the output's content; where the scene failed, of what an earlier run had left.
        splats: of the source, or of the result where the command says so.
        seconds: of the command.
        memory_bytes: the most that its process held.
        remarks: what the command said besides.
    """

    path: str
    output: str
    command: tuple[str, ...]
    version: str
    state: Literal["done", "failed"]
    sha256: str = ""
    code: str = ""
    error: str = ""
    source_bytes: int | None = None
    output_bytes: int | None = None
    output_sha256: str = ""
    splats: int | None = None
    seconds: float | None = None
    memory_bytes: int | None = None
    remarks: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, tuple[str, ...], str]:
        """What the output is made of: where this is the same it is not made again."""
        return self.sha256, self.command, self.version

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return asdict(self)


class Journal:
    """The records of a folder. Owns them, and the open file that lines are appended to.

    Args:
        folder: that of the outputs.

    Attributes:
        records: by output, the last of each.
        pending: outputs that a run which did not end by itself was to write: they are nobody else's.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL
        self.records, self.pending = read_journal(folder)
        self._file = self._path.open("ab", buffering=0)
        with self._path.open("rb") as stream:
            if stream.seek(0, os.SEEK_END) and (stream.seek(-1, os.SEEK_END), stream.read())[1] != b"\n":
                self._write_line(b"")  # half a line stays by itself

    def begin(self, outputs: Sequence[str]) -> None:
        """Note what a run is to write."""
        self._write_line(json.dumps({"state": _BEGUN, "outputs": list(outputs)}).encode())

    def add(self, record: Record) -> None:
        """Append the line of a scene that ended."""
        self.records[record.output] = record
        self._write_line(json.dumps(record.as_json()).encode())

    def end(self) -> None:
        """Leave one line for each scene; nothing can be added any more."""
        self.close()  # Windows replaces no file that is open
        lines = [json.dumps(one.as_json()) + "\n" for one in self.records.values()]
        write_bytes(str(self._path), "".join(lines).encode())

    def close(self) -> None:
        """Close the file; what stands in it stays."""
        self._file.close()

    def _write_line(self, line: bytes) -> None:
        left = memoryview(line + b"\n")
        while left:  # a full disk takes a part, and then none
            left = left[self._file.write(left) :]
        os.fsync(self._file.fileno())  # an output that is there after a power cut has to be known


@contextmanager
def open_journal(folder: Path) -> Iterator[Journal]:
    """Open the records of a folder, which one program at a time may do.

    Raises:
        InputError: another batch is at work there.
        OSError: it cannot be written.
    """
    with locked_folder(folder, _LOCK) as is_ours:
        if not is_ours:
            raise InputError(f"another batch writes to {folder}: wait for it, or name another folder")
        journal = Journal(folder)
        try:
            yield journal
        finally:
            journal.close()


def read_journal(folder: Path) -> tuple[dict[str, Record], set[str]]:
    """Records and what is pending, as `Journal` has them; nothing where there is no journal.

    Lines that are none are left out: a half one, or one of another version.

    Raises:
        OSError: it cannot be read.
    """
    records: dict[str, Record] = {}
    pending: set[str] = set()
    with suppress(FileNotFoundError), (folder / JOURNAL).open("rb") as stream:
        for line in stream:
            try:
                said = json.loads(line)
                if said["state"] == _BEGUN:
                    pending.update(said["outputs"])
                    continue
                record = _record(said)
            except (ValueError, KeyError, TypeError):
                continue
            records[record.output] = record
            pending.discard(record.output)
    return records, pending


def _record(said: dict[str, Any]) -> Record:
    known = {one.name for one in fields(Record)}
    values: dict[str, Any] = {name: value for name, value in said.items() if name in known}
    values |= {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return Record(**values)
