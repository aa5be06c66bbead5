"""The table of the wrong encoders, or one of them."""

import argparse
import sys
import time
from fnmatch import fnmatch
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # `python tests/wrong_encoders` puts the folder itself

import wrong_encoders
from csplat_conformance.encoders import LEVELS, all_inputs
from wrong_encoders.finding import find, first_sign, inputs_of, status_of
from wrong_encoders.mistake import Harm
from wrong_encoders.mistakes import GROUPS, MISTAKES

HEADER = ("mistake", "harm", "what the author believed", "caught by", "of inputs", "first")
SHOWN = 120  # characters of a message


def main():
    parser = argparse.ArgumentParser(
        prog="wrong_encoders", description=wrong_encoders.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", action="store_true", help="every mistake, and what the suite says first")
    parser.add_argument("--groups", nargs="*", default=list(GROUPS), choices=list(GROUPS), help="modules of mistakes")
    parser.add_argument("places", nargs="*", metavar="MISTAKE PLY OUT [INDEX]", help="encode with a mistake")
    args = parser.parse_args()
    if args.table:
        return table([name for group in args.groups for name in GROUPS[group]])
    return status_of(*args.places)


def table(names):
    """Print the mistakes as a table in Markdown; the status is 1 if one goes unnoticed."""
    began, missed = time.process_time(), []
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    for name in names:
        mistake = MISTAKES[name]
        row, caught = found(name)
        if not caught and mistake.harm is not Harm.HARMLESS:
            missed.append(name)
        print(f"| {' | '.join([name, str(mistake.harm), mistake.why, *row])} |", flush=True)
    print(f"\n{len(names)} wrong encoders, {time.process_time() - began:.0f} CPU seconds; not caught: {len(missed)}")
    for name in missed:
        print(f"    {name}")
    return 1 if missed else 0


def found(name):
    """Run the suite on a mistake's own inputs and the small ordinary ones; return three cells and whether it is caught.

    Mistakes in how the program ends run on their own inputs only.
    """
    mistake = MISTAKES[name]
    own = inputs_of(mistake)
    more = [] if mistake.end is not None else [one.name for one in all_inputs() if fnmatch(one.name, "ordinary/*")]
    names = list(dict.fromkeys([*own, *(one for one in more if one != "ordinary/two_tiles")]))
    report = find(name, names=names, levels=LEVELS)
    first = first_sign(report)
    if first is None:
        passes = "passes" if mistake.harm is Harm.HARMLESS else "NOT CAUGHT"
        return [passes if own else f"{passes}: no input shows it", f"0 of {len(names)}", ""], False
    signs = {one.name: one for one in reversed(report.failures)} or {first.name: first}
    earliest = min(signs.values(), key=lambda one: one.level)
    levels = ", ".join(sorted({f"{one.level} {one.status}" for one in report.failures or [first]}))
    message = " ".join(earliest.message.split())[:SHOWN].replace("|", "/")
    said = f"{earliest.name}: {earliest.level} {message}"
    return [" ".join([levels, *earliest.clauses]), f"{len(signs)} of {len(names)}", said], True


if __name__ == "__main__":
    sys.exit(main())
