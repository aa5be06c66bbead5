# SPDX-License-Identifier: Apache-2.0
"""Results of a command: files, standard output, remarks and progress, as the common options specify."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.types import Progress
from csplat_tools.console import LONG_WORK_SECONDS, format_estimate, note, print_data, print_json, progress_bar
from csplat_tools.file_streams import STANDARD_STREAM, check_name, check_outputs, write_json

#: True if data sets may read files outside of their folders. The program sets it for each command line.
TRUSTS_PATHS = ContextVar("TRUSTS_PATHS", default=False)

#: File name endings of the outputs of options.
_ENDINGS = {
    "--report": ".json", "--page": ".html", "--source-index": ".npy", "--checkpoint": ".npz", "--preview": ".png",
}  # fmt: skip


def default_output(output: str | None, source: str, ending: str) -> str:
    """Return the output, or the source's name with another ending if no output is given.

    Raises:
        InputError: no output is given, and the source has no name: `.`, `/` or nothing.
        typer.BadParameter: no output is given, and the source is standard input.
    """
    if output is not None:
        return output
    if source == STANDARD_STREAM:
        raise typer.BadParameter("expected an output: OUT, or - for standard output")
    if not Path(source).name:
        raise InputError(f"{source or 'an empty name'} is a folder, not a scene")
    return str(Path(source).with_suffix(ending))


@dataclass(frozen=True)
class Output:
    """The options that every command has.

    Attributes:
        force: replace existing files.
        report: file for the result as JSON.
        as_json: print the result as JSON.
        quiet: print neither progress nor remarks.
    """

    force: bool = False
    report: str | None = None
    as_json: bool = False
    quiet: bool = False

    def check(
        self,
        *outputs: str | None,
        inputs: Sequence[str | None] = (),
        named: Mapping[str, str | None] | None = None,
        force: bool = False,
    ) -> None:
        """Refuse unusable files before any work is done for them.

        Args:
            outputs: files that the command writes, or `-`; `None` for a file that is not requested.
            inputs: files that it reads; none of them may be written.
            named: other files that it writes, by option; not `-`, nor files with the ending of another kind.
            force: existing files may be replaced, even without --force.

        Raises:
            InputError: a file exists, two are the same, or a file has the ending of another kind.
            OSError: an input does not exist, or the folder of an output.
            typer.BadParameter: two outputs would go to standard output, or an output that cannot.
        """
        files = {"--report": self.report, **(named or {})}
        for name, path in files.items():
            if path == STANDARD_STREAM:
                raise typer.BadParameter(f"{name} requires the name of a file")
        if self.as_json and STANDARD_STREAM in outputs:
            raise typer.BadParameter("--json and - both use standard output")
        check_outputs((*outputs, *files.values()), force=self.force or force, inputs=inputs)
        for name, path in files.items():
            if path is not None and name in _ENDINGS:
                check_name(path, _ENDINGS[name], name)

    def publish(self, result: Any, text: str = "") -> None:
        """Publish the result: as JSON to the file of `--report`, and to standard output with `--json`, else as text.

        Args:
            result: JSON-compatible, without NaN and infinities.
            text: the result for people; empty if the result is a file.
        """
        if self.report is not None:
            write_json(self.report, result)
        if self.as_json:
            print_json(result)
        elif text:
            print_data(text)

    def remark(self, *lines: str) -> None:
        """Print remarks on standard error, unless `--quiet` is given."""
        for line in () if self.quiet else lines:
            note(line)

    def announce_time(self, estimate: Callable[[], float], faster: str) -> None:
        """Announce the time of long work.

        Args:
            estimate: returns the seconds; not called with `--quiet`.
            faster: advice on what takes less time.
        """
        seconds = 0.0 if self.quiet else estimate()
        if seconds > LONG_WORK_SECONDS:
            note(f"this takes about {format_estimate(seconds)} here; {faster}")

    def print_findings(self, findings: Sequence[Finding], name: str = "") -> None:
        """Print unusual findings in a file, unless `--quiet` is given. Repairs and losses are printed in any case.

        Args:
            findings: findings in the file.
            name: name of the file, if a command reads several.
        """
        for finding in findings:
            if finding.kind in ("repair", "loss") or not (self.quiet or finding.usual):
                note(f"{name}: {finding}" if name else str(finding))

    def bar(self) -> AbstractContextManager[Progress]:
        """Return the progress bar, see `progress_bar`."""
        return progress_bar(quiet=self.quiet)
