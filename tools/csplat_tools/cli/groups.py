"""Groups of options that belong together, and the one that every command has: where results go."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import typer

from csplat.lint import Finding
from csplat_tools.files.console import WORTH_SAYING, Progress, format_about, note, progress_bar, say, say_json
from csplat_tools.files.streams import STANDARD_STREAM, check_name, check_outputs, write_json

__all__ = ["Group", "Output"]

_ENDINGS = {
    "--report": ".json", "--page": ".html", "-o": ".html", "--source-index": ".npy", "--checkpoint": ".npz",
}  # fmt: skip


@dataclass(frozen=True)
class Group:
    """Options that belong together: the fields, with their defaults.

    Class attributes:
        one_of: of each of these options one at most may be given.
        needs: options that say nothing unless one of others is given.
    """

    one_of: ClassVar[Sequence[tuple[str, ...]]] = ()
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def parse(self) -> None:
        """Refuse words that say nothing, before any work is done.

        Raises:
            typer.BadParameter: there are such.
        """


@dataclass(frozen=True)
class Output(Group):
    """Where results go: the same for every command."""

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
            outputs: what the command writes, or `-`; `None` for what is not wanted.
            inputs: what it reads: none of them may be written.
            named: by option, what it writes beside them, which cannot be `-`, nor be named as something else.
            force: they may be replaced, whatever the user says.

        Raises:
            InputError: one exists, two are the same, or one has the name of something else.
            OSError: an input does not exist, or the folder of an output.
            typer.BadParameter: two of them want standard output, or one that cannot go there.
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
        """Give the result: as JSON into `--report` and with `--json`, else as text.

        Args:
            result: JSON-compatible, without NaN and infinities.
            text: what people read on standard output; nothing where a file is the result.
        """
        if self.report is not None:
            write_json(self.report, result)
        if self.as_json:
            say_json(result)
        elif text:
            say(text)

    def remark(self, *lines: str) -> None:
        """Tell people on standard error, unless they asked for silence."""
        for line in () if self.quiet else lines:
            note(line)

    def foretell(self, expected: Callable[[], float], sooner: str) -> None:
        """Tell people how long work takes, if that is long: they may choose otherwise.

        Args:
            expected: looks how many seconds; not called where nobody is told.
            sooner: what takes less.
        """
        seconds = 0.0 if self.quiet else expected()
        if seconds > WORTH_SAYING:
            note(f"this takes about {format_about(seconds)} here; {sooner}")

    def findings(self, findings: Sequence[Finding], name: str = "") -> None:
        """Tell what was noticed in a file that is not usual; what was repaired is told in any case.

        Args:
            findings: of the file.
            name: of the file, where a command reads several.
        """
        for one in findings:
            if one.kind == "repair" or not (self.quiet or one.usual):
                note(f"{name}: {one}" if name else str(one))

    def bar(self) -> AbstractContextManager[Progress | None]:
        """The progress bar, see `progress_bar`."""
        return progress_bar(quiet=self.quiet)
