"""`batch.jsonl`: a line for each scene that ended, and for each run that began.

A line is written at once, so that a program that is killed leaves whole lines behind, except perhaps the last. When a
run ends by itself, one line remains for each scene.
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
        output_sha256: hash of the output's content; if the scene failed, of the output that an earlier run left.
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
        """The inputs of the output: if they are the same again, it is not made again."""
        return self.sha256, self.command, self.version

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return asdict(self)


class Journal:
    """The records of a folder. Owns them, and the open file that lines are appended to.

    Args:
        folder: the folder of outputs.

    Attributes:
        records: the last record of each output.
        pending: outputs that a run which did not end by itself was to write; files there belong to the batch.
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
        """Close the file and keep its content."""
        self._file.close()

    def _write_line(self, line: bytes) -> None:
        left = memoryview(line + b"\n")
        while left:  # a full disk writes a part, and then raises
            left = left[self._file.write(left) :]
        os.fsync(self._file.fileno())  # an output that is there after a power cut has to be known


@contextmanager
def open_journal(folder: Path) -> Iterator[Journal]:
    """Open the records of a folder; only one program at a time may do so.

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
    """Read the records and the pending outputs as in `Journal`; both are empty if there is no journal.

    Lines that cannot be parsed are left out: an incomplete one, or one of another version.

    Raises:
        OSError: it cannot be read.
    """
    records: dict[str, Record] = {}
    pending: set[str] = set()
    with suppress(FileNotFoundError), (folder / JOURNAL).open("rb") as stream:
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
