# SPDX-License-Identifier: Apache-2.0
"""`SetFolder`: the folder that a data set may read. Names, masks, points and links that lead out of it are refused."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from csplat.errors import InputError

_NETWORK = ("//", "\\\\")  # asking Windows for such a path contacts the server that it names


@dataclass(frozen=True)
class SetFolder:
    """The folder of a data set, which others may have written.

    Attributes:
        path: the folder that the user named, or the folder of the named file.
        trusted: True if the set may read any path.
        images: a folder of images that the user named; it may be a link to anywhere.
    """

    path: Path
    trusted: bool = False
    images: Path | None = None

    @cached_property
    def _as_written(self) -> list[str]:
        """The allowed folders, absolute, with links as they are."""
        return [_absolute(root) for root in (self.path, self.images) if root is not None]

    @cached_property
    def _real(self) -> list[str]:
        """The allowed folders without links, as they are at the first access."""
        return [os.path.realpath(root) for root in (self.path, self.images) if root is not None]

    def holds(self, path: Path) -> bool:
        """Return True if a path is within the folder as it is written. The disk is not asked; links are not followed.

        Args:
            path: a path, relative to the current folder.
        """
        if self.trusted:
            return True
        plain = _absolute(path)
        return any(_is_below(plain, root) for root in (*self._as_written, *self._real))

    def checked(self, path: Path, where: str = "") -> Path:
        """Return a path of an existing file or folder.

        Args:
            path: the path, relative to the current folder.
            where: the file that names it, for messages.

        Raises:
            InputError: it is outside of the folder, as written or by a link.
        """
        if not self.holds(path):
            raise self.refusal(path, where)
        if not self.trusted and not any(_is_below(os.path.realpath(path), root) for root in self._real):
            raise self.refusal(path, where, by_link=True)
        return path

    def settled(self, path: Path) -> Path:
        """Return a path whose links are resolved, so that later changes of links have no effect.

        Raises:
            InputError: as for `checked`.
        """
        if self.trusted:
            return path
        real, root = os.path.realpath(self.checked(path)), self._real[0]
        return self.path / os.path.relpath(real, root) if _is_below(real, root) else Path(real)

    def finds(self, path: Path) -> bool:
        """Return True if a path that the folder holds is a file; links are followed."""
        try:
            return self.holds(path) and path.is_file()
        except OSError:  # the name is too long
            return False

    def finds_outside(self, path: Path) -> bool:
        """Return True if a path that the folder does not hold exists; no server is contacted."""
        try:
            return not self.holds(path) and not os.fspath(path).startswith(_NETWORK) and path.exists()
        except OSError:
            return False

    def refusal(self, path: Path, where: str = "", *, by_link: bool = False) -> InputError:
        """Return the error for a path outside of the folder."""
        subject = f"{where}: {path}" if where else f"{path}"
        fault = "is a link that leads out of" if by_link else "is outside of"
        return InputError(
            f"{subject} {fault} {self.path}, the folder of the data set: move it there, or allow it with --trust-paths"
        )


def _absolute(path: Path) -> str:
    """Return an absolute path without `..`; links are not followed."""
    return os.path.abspath(path)  # noqa: PTH100  # resolve would ask the disk, or a server


def _is_below(path: str, root: str) -> bool:
    """Return True if an absolute path is a folder or below it, by its text alone, in any case on Windows."""
    try:
        return os.path.commonpath([os.path.normcase(path), os.path.normcase(root)]) == os.path.normcase(root)
    except ValueError:  # on another drive
        return False
