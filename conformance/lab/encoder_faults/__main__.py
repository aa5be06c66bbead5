# SPDX-License-Identifier: CC0-1.0
"""Print the table of faulty encoders, or run one of them."""

import argparse
import sys
import time
from fnmatch import fnmatch

import encoder_faults
from csplat_conformance.encoders import LEVELS, all_inputs
from encoder_faults.fault import Harm
from encoder_faults.run import FAULTS, GROUPS, find, first_sign, inputs_of, status_of

HEADER = ("fault", "harm", "mistaken belief", "caught by", "of inputs", "first message")
SHOWN = 120  # characters of a message; longer ones are cut


def main():
    parser = argparse.ArgumentParser(
        prog="encoder_faults", description=encoder_faults.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", action="store_true", help="list every fault with the suite's first message")
    parser.add_argument("--groups", nargs="*", default=list(GROUPS), choices=list(GROUPS), help="modules to list")
    parser.add_argument("places", nargs="*", metavar="FAULT PLY OUT [INDEX]", help="encode with a fault")
    args = parser.parse_args()
    if args.table:
        return table([name for group in args.groups for name in GROUPS[group]])
    return status_of(*args.places)


def table(names):
    """Print the faults as a Markdown table; return exit status 1 if a fault is not caught."""
    began, missed = time.process_time(), []
    print(f"| {' | '.join(HEADER)} |\n|{'---|' * len(HEADER)}")
    for name in names:
        fault = FAULTS[name]
        row, caught = found(name)
        if not caught and fault.harm is not Harm.HARMLESS:
            missed.append(name)
        print(f"| {' | '.join([name, str(fault.harm), fault.why, *row])} |", flush=True)
    print(f"\n{len(names)} faulty encoders, {time.process_time() - began:.0f} CPU seconds; not caught: {len(missed)}")
    for name in missed:
        print(f"    {name}")
    return 1 if missed else 0


def found(name):
    """Run the suite on a fault's own inputs and the small ordinary ones; return three cells, and True if it is caught.

    Faults with an `end` run on their own inputs only.
    """
    fault = FAULTS[name]
    own = inputs_of(fault)
    more = [] if fault.end is not None else [one.name for one in all_inputs() if fnmatch(one.name, "ordinary/*")]
    names = list(dict.fromkeys([*own, *(one for one in more if one != "ordinary/two_tiles")]))
    report = find(name, names=names, levels=LEVELS)
    first = first_sign(report)
    if first is None:
        passes = "passes" if fault.harm is Harm.HARMLESS else "NOT CAUGHT"
        return [passes if own else f"{passes}: no input shows it", f"0 of {len(names)}", ""], False
    signs = {one.name: one for one in reversed(report.failures)} or {first.name: first}
    earliest = min(signs.values(), key=lambda one: one.level)
    levels = ", ".join(sorted({f"{one.level} {one.status}" for one in report.failures or [first]}))
    message = " ".join(earliest.message.split())[:SHOWN].replace("|", "/")
    shown = f"{earliest.name}: {earliest.level} {message}"
    return [" ".join([levels, *earliest.clauses]), f"{len(signs)} of {len(names)}", shown], True


if __name__ == "__main__":
    sys.exit(main())
