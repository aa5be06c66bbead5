"""Areas: tests that leave `make test` until the sources they guard change.

`areas.toml` lists each area with the faults its tests guard against, its sources, and a hash of these. A test belongs
to an area by `@pytest.mark.area(name="engines")`. `make test` leaves out every area whose sources still have the
recorded hash; `make test-all` runs all of them.

    python tests/areas.py list                # each area, and whether its sources have changed
    python tests/areas.py changed             # names of areas that have changed
    python tests/areas.py expression          # the -m expression of `make test`
    python tests/areas.py expression --fast   # the same of `make check`: no slow tests, areas or shared scenes
    python tests/areas.py extras              # the extras of pyproject.toml that changed areas need
    python tests/areas.py record [NAME ...]   # record the hashes of areas whose tests passed; default: all
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "tests" / "areas.toml"
_SKIPPED = {"__pycache__", "node_modules"}


@dataclass(frozen=True)
class Area:
    """A group of tests that `make test` runs only after a change of its sources.

    Attributes:
        name: the name that markers use.
        guards: the faults that its tests find.
        sources: glob patterns relative to the root of the project.
        extras: extras of pyproject.toml that its tests need beyond `dev`.
        hash: hex digest of the sources when its tests last passed; empty if they never did.
    """

    name: str
    guards: str
    sources: tuple[str, ...]
    extras: tuple[str, ...] = ()
    hash: str = ""

    def files(self, root: Path = ROOT) -> list[Path]:
        """Return the source files in a fixed order.

        Raises:
            ValueError: a pattern matches no file.
        """
        found: set[Path] = set()
        for pattern in self.sources:
            matched = {path for path in root.glob(pattern) if path.is_file() and not _SKIPPED & set(path.parts)}
            if not matched:
                raise ValueError(f"area {self.name}: {pattern} matches no file")
            found |= matched
        return sorted(found)

    def digest(self, root: Path = ROOT) -> str:
        """Return the hash of names and contents of the sources; line ends do not count."""
        total = hashlib.sha256()
        for path in self.files(root):
            content = path.read_bytes().replace(b"\r\n", b"\n")
            total.update(f"{path.relative_to(root).as_posix()}\0{len(content)}\0".encode())
            total.update(content)
        return total.hexdigest()[:16]

    def is_changed(self, root: Path = ROOT) -> bool:
        """Return whether the sources differ from those whose tests passed."""
        return self.digest(root) != self.hash


def load(file: Path = FILE) -> list[Area]:
    """Read the areas."""
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    return [
        Area(name, table["guards"], tuple(table["sources"]), tuple(table.get("extras", ())), table.get("hash", ""))
        for name, table in tables.items()
    ]


def expression(areas: list[Area], *, fast: bool = False, root: Path = ROOT) -> str:
    """Return the marker expression that selects the tests of a tier.

    Args:
        areas: all areas.
        fast: `make check`: neither slow tests nor areas nor scenes that no clone has.
        root: root of the project.
    """
    if fast:
        return "not slow and not area and not shared_data"
    names = [area.name for area in areas if area.is_changed(root)]
    return " or ".join(["not area", *(f"area(name='{name}')" for name in names)])


def record(names: list[str], file: Path = FILE, root: Path = ROOT) -> list[str]:
    """Write the present hashes of areas into the file; return the names of those that changed."""
    text, changed = file.read_text(encoding="utf-8"), []
    for area in load(file):
        if area.name in names and area.is_changed(root):
            pattern = rf'(?ms)(^\[{re.escape(area.name)}\]$.*?^hash = )"[^"]*"'
            text, count = re.subn(pattern, rf'\g<1>"{area.digest(root)}"', text, count=1)
            assert count == 1, f"area {area.name} has no line `hash = ...`"
            changed.append(area.name)
    file.write_text(text, encoding="utf-8", newline="\n")
    return changed


def main(words: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="each area, and whether its sources have changed")
    commands.add_parser("changed", help="names of areas whose sources have changed")
    tier = commands.add_parser("expression", help="the marker expression of a tier")
    tier.add_argument("--fast", action="store_true", help="of `make check`")
    commands.add_parser("extras", help="extras that changed areas need, separated by commas")
    recorded = commands.add_parser("record", help="record hashes, after the tests passed")
    recorded.add_argument("names", nargs="*", metavar="NAME", help="default: all areas")
    args = parser.parse_args(words)
    areas = load()
    known = [area.name for area in areas]
    match args.command:
        case "list":
            for area in areas:
                print(f"{area.name:12} {'changed' if area.is_changed() else 'as recorded':12} {area.guards}")
        case "changed":
            print(" ".join(area.name for area in areas if area.is_changed()))
        case "expression":
            print(expression(areas, fast=args.fast))
        case "extras":
            print(",".join(sorted({extra for area in areas if area.is_changed() for extra in area.extras})))
        case "record":
            unknown = set(args.names) - set(known)
            if unknown:
                parser.error(f"{', '.join(sorted(unknown))}: no such area, expected {', '.join(known)}")
            for name in record(args.names or known):
                print(f"recorded {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
