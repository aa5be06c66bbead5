"""`batch.jsonl`: a line for each finished scene, and for each run that began.

Lines are written one by one, so that a killed program leaves whole lines, except perhaps the last. A run that ends
normally leaves one line per scene.
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
from csplat.file_source import named_errors, open_binary
from csplat.system import locked_folder
from csplat_tools.file_streams import write_bytes

JOURNAL = "batch.jsonl"
_LOCK = ".batch.lock"  # file that is locked, on Windows only
_BEGUN = "begun"


@dataclass(frozen=True)
class Record:
    """The outcome of one scene.

    Attributes:
        path: path of the source, or its URL.
        output: path within the folder of outputs, or a URL.
        command: the command with its options, as words.
        version: version of the program.
        state: `done` or `failed`.
        sha256: hash of the source's content; "" if it could not be read.
        code: code of the error, such as `E_INPUT` or `ENOENT`; "" if there is none.
        error: the error in one line.
        source_bytes, output_bytes: sizes of the files.
        output_sha256: hash of the output's content; if the scene failed, of an earlier run's output.
        splats: number of splats of the result if the command reports it, else of the source.
        seconds: time that the command took.
        memory_bytes: peak memory of its process.
        remarks: other messages of the command.
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
        """The inputs that determine the output."""
        return self.sha256, self.command, self.version

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return asdict(self)


class Journal:
    """The records of a folder of outputs. Owns them, and the open file that lines are appended to.

    Attributes:
        records: the last record of each output.
        pending: outputs of an interrupted run without a record; files under these names belong to the batch.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL
        self.records, self.pending = read_journal(folder)
        self._file = self._path.open("ab", buffering=0)
        with open_binary(self._path) as stream:
            if stream.seek(0, os.SEEK_END) and (stream.seek(-1, os.SEEK_END), stream.read())[1] != b"\n":
                self._write_line(b"")  # ends an incomplete line

    def begin(self, outputs: Sequence[str]) -> None:
        """Record the outputs that a run is going to write."""
        self._write_line(json.dumps({"state": _BEGUN, "outputs": list(outputs)}).encode())

    def add(self, record: Record) -> None:
        """Append the line of a finished scene."""
        self.records[record.output] = record
        self._write_line(json.dumps(record.as_json()).encode())

    def end(self) -> None:
        """Rewrite the file with one line per scene, and close it."""
        self.close()  # Windows cannot replace an open file
        lines = [json.dumps(one.as_json()) + "\n" for one in self.records.values()]
        write_bytes(str(self._path), "".join(lines).encode())

    def close(self) -> None:
        """Close the file and keep its content."""
        self._file.close()

    def _write_line(self, line: bytes) -> None:
        rest = memoryview(line + b"\n")
        with named_errors(self._path):
            while rest:  # on a full disk, a write may be partial before one raises
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())  # so that after a power cut no output exists without its line


@contextmanager
def open_journal(folder: Path) -> Iterator[Journal]:
    """Open the records of a folder; only one program at a time may do so.

    Raises:
        InputError: another batch uses the folder.
        OSError: the file cannot be written.
    """
    with locked_folder(folder, _LOCK) as is_ours:
        if not is_ours:
            raise InputError(f"another batch writes to {folder}: wait until it ends, or use another folder")
        journal = Journal(folder)
        try:
            yield journal
        finally:
            journal.close()


def read_journal(folder: Path) -> tuple[dict[str, Record], set[str]]:
    """Read the records and the pending outputs as in `Journal`; both are empty if there is no journal.

    Lines that cannot be parsed are skipped: incomplete ones, or those of another version.
    """
    records: dict[str, Record] = {}
    pending: set[str] = set()
    with suppress(FileNotFoundError), open_binary(folder / JOURNAL) as stream:
        for line in stream:
            try:
                entry = json.loads(line)
                if entry["state"] == _BEGUN:
                    pending.update(entry["outputs"])
                    continue
                record = _record(entry)
            except (ValueError, KeyError, TypeError):
                continue
            records[record.output] = record
            pending.discard(record.output)
    return records, pending


def _record(entry: dict[str, Any]) -> Record:
    known = {one.name for one in fields(Record)}
    values: dict[str, Any] = {name: value for name, value in entry.items() if name in known}
    values |= {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return Record(**values)
