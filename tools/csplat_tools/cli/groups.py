"""Groups of options that belong together, and the one that every command has: its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import typer

from csplat.lint import Finding
from csplat.types import Progress
from csplat_tools.files.console import WORTH_SAYING, format_about, note, progress_bar, say, say_json
from csplat_tools.files.streams import STANDARD_STREAM, check_name, check_outputs, write_json

_ENDINGS = {
    "--report": ".json", "--page": ".html", "-o": ".html", "--source-index": ".npy", "--checkpoint": ".npz",
}  # fmt: skip


@dataclass(frozen=True)
class Group:
    """Options that belong together: the fields, with their defaults.

    Class attributes:
        one_of: groups of options, of each of which at most one may be given.
        needs: options that have no effect unless one of the named others is given.
    """

    one_of: ClassVar[Sequence[tuple[str, ...]]] = ()
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def parse(self) -> None:
        """Refuse invalid values before any work is done.

        Raises:
            typer.BadParameter: a value is invalid.
        """


@dataclass(frozen=True)
class Output(Group):
    """Options that tell where results go, the same for every command."""

    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False
    report: Annotated[str | None, typer.Option(metavar="FILE.json", help="Write the result as JSON.")] = None
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no remarks.")] = False

    def check(
        self,
        *outputs: str | None,
        inputs: Sequence[str | None] = (),
        named: Mapping[str, str | None] | None = None,
        force: bool = False,
    ) -> None:
        """Refuse files before any work is done for them.

        Args:
            outputs: files that the command writes, or `-`; `None` for one that is not requested.
            inputs: files that it reads; none of them may be written.
            named: other files that it writes, by option; they cannot be `-`, and their names must not end like those
                of other kinds of files.
            force: existing files may be replaced, even without --force.

        Raises:
            InputError: a file exists, two are the same, or one has a name for another kind of file.
            OSError: an input does not exist, or the folder of an output.
            typer.BadParameter: two outputs would go to standard output, or one that cannot.
        """
        files = {"--report": self.report, **(named or {})}
        for name, path in files.items():
            if path == STANDARD_STREAM:
                raise typer.BadParameter(f"{name} wants the name of a file")
        if self.as_json and STANDARD_STREAM in outputs:
            raise typer.BadParameter("--json and - both want standard output")
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
            say_json(result)
        elif text:
            say(text)

    def remark(self, *lines: str) -> None:
        """Print remarks on standard error, unless `--quiet` is given."""
        for line in () if self.quiet else lines:
            note(line)

    def foretell(self, expected: Callable[[], float], sooner: str) -> None:
        """Announce how long the work takes if it is long, so that people may choose otherwise.

        Args:
            expected: estimates the seconds; not called with `--quiet`.
            sooner: advice on what takes less time.
        """
        seconds = 0.0 if self.quiet else expected()
        if seconds > WORTH_SAYING:
            note(f"this takes about {format_about(seconds)} here; {sooner}")

    def findings(self, findings: Sequence[Finding], name: str = "") -> None:
        """Print unusual findings in a file, unless `--quiet` is given; repairs are printed in any case.

        Args:
            findings: findings in the file.
            name: name of the file, if a command reads several.
        """
        for one in findings:
            if one.kind == "repair" or not (self.quiet or one.usual):
                note(f"{name}: {one}" if name else str(one))

    def bar(self) -> AbstractContextManager[Progress | None]:
        """Return the progress bar, see `progress_bar`."""
        return progress_bar(quiet=self.quiet)
