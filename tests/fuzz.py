"""Fuzz the decoder: structure-aware mutants of the conformance vectors, all checksums repaired.

A mutant must decode within small limits or be refused with a CsplatError (CNF-3). Anything else, a case that takes
longer than five seconds, or memory beyond the limit is a finding: it is made smaller and saved, exit status 1.

    python tests/fuzz.py --seconds 60
    python tests/fuzz.py --count 100000 --seed 7 --jobs 2
    python tests/fuzz.py --seconds 600 scene.csplat
    python tests/fuzz.py --case 1234 --seed 7          # one case again, its bytes on standard output

Case number n of a seed is the same whatever the number of jobs.
"""

from __future__ import annotations

import argparse
import multiprocessing
import queue
import random
import resource
import signal
import sys
import time
import traceback
import zlib
from collections import Counter
from pathlib import Path

from csplat import decoder
from csplat.errors import CsplatError
from csplat_conformance.builder import build
from csplat_conformance.mutate import mapped, mutant
from csplat_conformance.recipes import all_recipes
from csplat_conformance.repair import repair

LIMITS = decoder.Limits(splats=100_000, bytes=32_000_000, json_bytes=1_000_000)
SECONDS_PER_CASE = 5
MEMORY_ABOVE_START = 256_000_000  # bytes of resident memory; the limits allow 32 MB of arrays
ADDRESS_SPACE_ABOVE_START = 2_000_000_000  # allocations beyond this fail with MemoryError at once
LARGEST_BASE = 3000  # bytes: small files make many cases a second
BATCH = 200
OUT = Path("out/fuzz")


class TooSlowError(Exception):
    """A case ran longer than it may."""


def main() -> int:
    args = arguments()
    if args.case is not None:
        data, _ = case(args.seed, args.case, bases(args.files))
        sys.stdout.buffer.write(data)
        return 0
    began = time.monotonic()
    tally, findings = run(args)
    seconds = time.monotonic() - began
    report(tally, findings, seconds, args)
    return 1 if findings else 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="further valid files to start from")
    parser.add_argument("--seconds", type=float, help="stop after this time (default 60)")
    parser.add_argument("--count", type=int, help="stop after this many cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--case", type=int, help="write the bytes of this case and stop")
    args = parser.parse_args()
    if args.seconds is None and args.count is None:
        args.seconds = 60.0
    return args


def bases(files):
    """Return the files that mutants start from: valid vectors with all their fields, and the given ones."""
    built = [build(recipe.scene) for recipe in all_recipes() if recipe.scene is not None]
    small = [base for base in built if len(base.data) <= LARGEST_BASE]
    return small + [mapped(path.read_bytes()) for path in files]


def case(seed, number, starts):
    """Return case `number` of a seed: its bytes, and whether checksums were repaired."""
    return mutant(random.Random(f"{seed} {number}"), starts)  # noqa: S311 - repeatable, no secret


# Parent --------------------------------------------------------------------------------------------


def run(args):
    """Share the cases among processes until time or count is used up; return tally and findings."""
    context = multiprocessing.get_context("spawn")
    results, stop = context.Queue(), context.Event()
    clocks = [context.Value("d", 0.0) for _ in range(args.jobs)]
    processes = [
        context.Process(target=work, args=(k, args, clocks[k], results, stop), daemon=True) for k in range(args.jobs)
    ]
    for process in processes:
        process.start()
    tally, findings, done = Counter(), [], 0
    deadline = None
    while done < args.jobs:
        try:
            kind, value = results.get(timeout=1)
        except queue.Empty:
            kind, value = "nothing", None
        if kind == "started" and args.seconds is not None and deadline is None:
            deadline = time.monotonic() + args.seconds
        elif kind == "tally":
            tally += value
        elif kind == "finding" and value["what"] not in {finding["what"] for finding in findings}:
            findings.append(value)
            print(f"FINDING case {value['case']}: {value['what']}", file=sys.stderr)
        elif kind == "done":
            done += 1
        if deadline is not None and time.monotonic() > deadline:
            stop.set()
        done += stuck(processes, clocks, findings)
    return tally, findings


def stuck(processes, clocks, findings):
    """Kill workers that do not come back from a case, or have died in one; return how many."""
    gone = 0
    for k, process in enumerate(processes):
        if process is None:
            continue
        since = clocks[k].value
        hangs = since and time.monotonic() - since > 4 * SECONDS_PER_CASE
        if hangs or (process.exitcode not in (None, 0)):
            what = "hang in native code" if hangs else f"the process died: {process.exitcode}"
            findings.append({"case": f"of worker {k}", "what": what, "path": "-"})
            process.kill()
            processes[k] = None
            gone += 1
    return gone


def report(tally, findings, seconds, args):
    executions = sum(count for name, count in tally.items() if not name.startswith("("))
    rate = executions / max(seconds, 1e-9)
    print(f"{executions:,} executions in {seconds:.0f} s, {rate:,.0f}/s, seed {args.seed}, {args.jobs} processes")
    for name, count in sorted(tally.items(), key=lambda item: (item[0].startswith("("), -item[1])):
        print(f"  {name:<16} {count:>9,}  {100 * count / max(executions, 1):5.1f} %")
    for finding in findings:
        print(f"FINDING case {finding['case']}: {finding['what']}, saved as {finding['path']}")
    print(f"{len(findings)} kinds of findings")


# Worker --------------------------------------------------------------------------------------------


def work(k, args, clock, results, stop):
    """Run every case whose number is k modulo the number of processes."""
    starts = bases(args.files)
    for base in starts:
        decoder.decode(base.data)  # warms up whatever loads late
    signal.signal(signal.SIGALRM, too_slow)
    start_bytes = limit_memory()
    results.put(("started", k))
    tally, number, known = Counter(), k, set()
    while not stop.is_set() and (args.count is None or number < args.count):
        clock.value = time.monotonic()
        data, repaired = case(args.seed, number, starts)
        name, what = attempt(data)
        grown = resident_bytes() - start_bytes
        if not what and grown > MEMORY_ABOVE_START:
            what, start_bytes = f"resident memory grew by {grown:,} bytes", resident_bytes()
        tally[name] += 1
        tally["(not repaired)"] += not repaired
        if what and what not in known:
            known.add(what)
            results.put(("finding", saved(args.seed, number, data, what, starts)))
        number += args.jobs
        if sum(tally.values()) >= BATCH:
            results.put(("tally", tally))
            tally = Counter()
    clock.value = 0.0
    results.put(("tally", tally))
    results.put(("done", k))


def attempt(data):
    """Decode one mutant: (name for the tally, what is wrong or an empty string)."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS_PER_CASE)
    try:
        chance = zlib.crc32(data)
        # One thread is three times as fast on small files; now and then as many as there are.
        model = decoder.decode(data, limits=LIMITS, threads=1 if chance % 16 else None)
        if chance % 8 == 1:
            return agreed(data, len(model))
    except CsplatError as error:
        return error.code, ""
    except TooSlowError:
        return "finding", f"slower than {SECONDS_PER_CASE} s"
    except BaseException as error:  # noqa: BLE001 - every other exception is what this program looks for
        where = traceback.extract_tb(error.__traceback__)[-1]
        return "finding", f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if len(model) > LIMITS.splats:
        return "finding", "more splats than the limits allow"
    return "decoded", ""


def agreed(data, count):
    """Decode a sound file in the other ways: they must find it sound too."""
    try:
        integers = decoder.decode_integers(data, limits=LIMITS, threads=1)
        tiles = list(decoder.iter_tiles(data, limits=LIMITS))
    except CsplatError as error:
        return "finding", f"decode accepts what another way refuses: {error}"
    if not len(integers["means"]) == sum(len(tile.means) for tile in tiles) == count:
        return "finding", "ways of decoding differ in the number of splats"
    return "decoded", ""


def too_slow(signal_number, frame):  # noqa: ARG001 - the signature of a handler
    raise TooSlowError


def limit_memory():
    """Bound the address space of this process; return its resident bytes now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + ADDRESS_SPACE_ABOVE_START
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return resident_bytes()


def resident_bytes():
    """Return the largest resident size so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def saved(seed, number, data, what, starts):
    """Make a finding smaller and write it; return what to print."""
    OUT.mkdir(parents=True, exist_ok=True)
    small = minimised(data, what, starts)
    path = OUT / f"seed{seed}-case{number}.csplat"
    path.write_bytes(small)
    return {"case": number, "what": what, "path": str(path)}


def minimised(data, what, starts):
    """Undo as many changed bytes as leave the finding in place, where the length is that of a base."""
    if not what or what.startswith(("slower", "resident")):
        return data
    same = [base.data for base in starts if len(base.data) == len(data)]
    if not same:
        return data
    base = min(same, key=lambda other: sum(a != b for a, b in zip(other, data, strict=True)))
    for at in [i for i in range(len(data)) if data[i] != base[i]]:
        candidate = repair(data[:at] + base[at : at + 1] + data[at + 1 :])
        if attempt(candidate)[1] == what:
            data = candidate
    return data


if __name__ == "__main__":
    sys.exit(main())
