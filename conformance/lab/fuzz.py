# SPDX-License-Identifier: CC0-1.0
"""Fuzz the decoders and the readers of PLY and other formats with structured damage and repaired checksums.

| target | must |
|---|---|
| decoder | decode within small limits, or refuse with a CsplatError (CNF-3) |
| others | in JavaScript and C give the verdict and the arrays of the Python decoder |
| validator | report errors exactly where the decoder refuses ||
| ply | give a sound model or an InputError, in agreement with lint ||
| formats | give a sound model or an InputError |

Anything else, a case that takes more than five seconds of processor time, or memory beyond the limit is a finding: it
is made smaller and saved below out/fuzz, exit status 1. What reaches edges between lines that nothing reached before
joins the corpus.

    python conformance/lab/fuzz.py --seconds 60
    python conformance/lab/fuzz.py --target others --target ply --seconds 600 --seed 7
    python conformance/lab/fuzz.py --target decoder --count 100000 --jobs 2 scene.csplat
    python conformance/lab/fuzz.py --target ply --replay conformance/lab/corpus/ply

Process k of a seed and a number of jobs sees the same cases each time, until its time is up; each target has its own.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import queue
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from csplat_selftest.fuzzing.decoder_targets import DecoderTarget, OthersTarget, ValidatorTarget, missing_others
from csplat_selftest.fuzzing.edges import Edges
from csplat_selftest.fuzzing.file_targets import FormatTarget, PlyTarget

TARGETS = ("decoder", "others", "validator", "ply", "formats")
REPLAYED_MAX = 20  # files whose fate is printed one by one
SECONDS_PER_CASE = 5
HANG_SECONDS = 60  # in native code, where no alarm arrives
MEMORY_ABOVE_START = 256_000_000  # bytes of resident memory; the limits allow 32 MB of arrays
ADDRESS_SPACE_ABOVE_START = 2_000_000_000  # allocations beyond this fail with MemoryError at once
TRACED_SHARE = 0.5  # share of the cases that are traced: tracing takes three times as long
GROWN_SHARE = 0.5  # share of the cases that start from the corpus that grew, the others from the seeds
GROWN_MAX = 4000
PLAIN_SEEDS = 20  # seeds that a plain run reads as they are, to warm up; the conformance suite reads them all
SOURCE_BYTES_MAX = 20_000
BATCH_SECONDS = 1.0
NUMBER = re.compile(r"0x[0-9a-f]+|[0-9]+")


class TooSlowError(BaseException):
    """A case exceeded its time. Not an Exception, so that no handler on the way catches it."""


def main() -> int:
    args = arguments()
    targets = list(TARGETS) if "all" in args.target else args.target
    if "others" in targets:
        for name, why in missing_others().items():
            print(f"SKIPPED: the decoder in {name}: {why}", file=sys.stderr)
        if targets == ["others"] and len(missing_others()) == len(("JavaScript", "C")):
            return 1
    if args.replay:
        return replay(targets[0], args.files)
    if args.seconds is not None:
        args.seconds /= len(targets)
    findings = []
    for name in targets:
        began = time.monotonic()
        tally, found, reached = run(name, args)
        findings += found
        report(name, tally, found, reached, time.monotonic() - began, args)
    print(f"{len(findings)} kinds of findings")
    return 1 if findings else 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="further valid files to start from, of one target")
    parser.add_argument(
        "--target", action="append", choices=(*TARGETS, "all"), help="what is fuzzed; may repeat (default decoder)"
    )
    parser.add_argument("--seconds", type=float, help="stop after this time, shared among the targets (default 60)")
    parser.add_argument("--count", type=int, help="stop after this many cases of each target")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="where findings go (default out/fuzz)")
    parser.add_argument("--plain", action="store_true", help="without coverage: neither guided nor reported")
    parser.add_argument(
        "--replay", action="store_true", help="read files, or those of folders, as they are: what becomes of them?"
    )
    args = parser.parse_args()
    args.target = args.target or ["decoder"]
    one = len(args.target) == 1 and args.target != ["all"]
    if args.replay and not (one and args.files):
        parser.error("--replay requires one --target and files")
    if args.files and not one:
        parser.error("files belong to one --target")
    if args.seconds is None and args.count is None:
        args.seconds = 60.0
    return args


def made(name, scratch=None):
    """Return a target."""
    if name == "others":
        return OthersTarget(scratch)
    return {"decoder": DecoderTarget, "validator": ValidatorTarget, "ply": PlyTarget, "formats": FormatTarget}[name]()


def replay(name, paths):
    """Let a target read unchanged files."""
    target, tally = made(name), Counter()
    signal.signal(signal.SIGPROF, too_slow)
    files = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    for file in files:
        became, what = attempt(target, file.read_bytes())
        tally[became] += 1
        if what or len(files) <= REPLAYED_MAX:
            print(f"{file}: {became}{': ' * bool(what)}{what}")
    target.close()
    print(f"{name}: {len(files):,} files: {', '.join(f'{count:,} {became}' for became, count in tally.most_common())}")
    return 1 if tally["finding"] else 0


# Parent --------------------------------------------------------------------------------------------
def run(name, args):
    """Share the cases among processes until time or count is used up; return tally, findings, coverage."""
    context = multiprocessing.get_context("spawn")
    results, stop = context.Queue(), context.Event()
    clocks = [context.Value("d", 0.0) for _ in range(args.jobs)]
    with tempfile.TemporaryDirectory(prefix="csplat-fuzz-") as scratch:
        jobs = [(k, name, args, clocks[k], results, stop, Path(scratch)) for k in range(args.jobs)]
        processes = [context.Process(target=work, args=job, daemon=False) for job in jobs]
        for process in processes:
            process.start()
        tally, findings, lines = gathered(args, processes, clocks, results, stop)
        for process in processes:
            if process is not None:
                process.join()
        reached = [] if args.plain else covered(name, args, lines, Path(scratch))
    return tally, findings, reached


def covered(name, args, lines, scratch):
    """Write the lines that nothing reached; return the lines of the report on coverage."""
    target = made(name, scratch)
    every = Edges(target.watched).all_lines()
    reached = [f"{len(lines & every):,} of {len(every):,} lines of functions"]
    reached += [text for text in (target.coverage(),) if text]
    missing = sorted(f"{Path(file).name}:{line}" for file, line in every - lines)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / f"{name}-unreached.txt").write_text("\n".join(missing) + "\n", encoding="utf-8")
    target.close()
    return reached


def gathered(args, processes, clocks, results, stop):
    """Collect what the processes report until all are done; stop them when the time is up."""
    tally, findings, lines, done, deadline = Counter(), [], set(), 0, None
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
            print(
                f"FINDING case {value['case']}: {value['what']}, saved as {value['path']}", file=sys.stderr, flush=True
            )
        elif kind == "done":
            done += 1
            lines |= value
        if deadline is not None and time.monotonic() > deadline:
            stop.set()
        done += stuck(processes, clocks, findings)
    return tally, findings, lines


def stuck(processes, clocks, findings):
    """Kill workers that hang or died in a case; return their number."""
    gone = 0
    for k, process in enumerate(processes):
        if process is None:
            continue
        since = clocks[k].value
        hangs = since and time.monotonic() - since > HANG_SECONDS
        if hangs or (process.exitcode not in (None, 0)):
            what = "hang in native code" if hangs else f"the process died: {process.exitcode}"
            findings.append({"case": f"of worker {k}", "what": what, "path": "-"})
            process.kill()
            processes[k] = None
            gone += 1
    return gone


def report(name, tally, findings, reached, seconds, args):
    executions = sum(count for key, count in tally.items() if not key.startswith("("))
    rate = executions / max(seconds, 1e-9)
    print(
        f"{name}: {executions:,} executions in {seconds:.0f} s, {rate:,.0f}/s, seed {args.seed}, {args.jobs} processes"
    )
    for text in reached:
        print(f"  coverage: {text}")
    for key, count in sorted(tally.items(), key=lambda item: (item[0].startswith("("), -item[1])):
        print(f"  {key:<16} {count:>9,}  {100 * count / max(executions, 1):5.1f} %")
    for finding in findings:
        print(f"FINDING case {finding['case']}: {finding['what']}, saved as {finding['path']}")


# Worker --------------------------------------------------------------------------------------------
def work(k, name, args, clock, results, stop, scratch):
    """Run every case whose number is k modulo the number of processes."""
    target = made(name, scratch)
    seeds, grown = target.seeds(args.files), []
    edges = Edges(target.watched)
    for seed in seeds[:PLAIN_SEEDS] if args.plain else seeds:
        became, what = attempt(target, seed.data)  # warms up whatever loads late
        assert not what, f"a seed is a finding: {what}"
    signal.signal(signal.SIGPROF, too_slow)
    start_bytes = limit_memory()
    results.put(("started", k))
    tally, number, known, told = Counter(), k, set(), time.monotonic()
    while not stop.is_set() and (args.count is None or number < args.count):
        clock.value = time.monotonic()
        one, traced = case(target, args.seed, number, seeds, grown, plain=args.plain)
        run = functools.partial(attempt, target, one.data)
        (became, what), new = edges.watch(run) if traced else (run(), 0)
        if new and not what:
            tally["(new edges)"] += 1
            source = one.source() if len(one.data) < SOURCE_BYTES_MAX and len(grown) < GROWN_MAX else None
            grown += [source] if source is not None else []
        what = what or target.memory()
        used = resident_bytes() - start_bytes
        if not what and used > MEMORY_ABOVE_START:
            what, start_bytes = f"resident memory grew by {used:,} bytes", resident_bytes()
        tally.update((became, *one.notes))
        if what and what not in known:
            known.add(what)
            results.put(("finding", saved(target, args, number, one.data, what, seeds)))
        number += args.jobs
        if time.monotonic() - told > BATCH_SECONDS:
            results.put(("tally", tally))
            tally, told = Counter(), time.monotonic()
    clock.value = 0.0
    results.put(("tally", tally))
    target.close()
    results.put(("done", set() if args.plain else edges.lines()))


def case(target, seed, number, seeds, grown, *, plain=False):
    """Return case `number` of a seed, and whether its coverage is recorded."""
    rng = random.Random(f"{target.name} {seed} {number}")  # noqa: S311 - repeatable, no secret
    traced = not plain and rng.random() < TRACED_SHARE
    corpus = grown if grown and rng.random() < GROWN_SHARE else seeds
    return target.case(rng, corpus), traced


def attempt(target, data):
    """Let the target read one file; return the name for the tally, and the finding or an empty string."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS_PER_CASE)
    try:
        return target.attempt(data)
    except TooSlowError:
        return "finding", f"more than {SECONDS_PER_CASE} s of processor time"
    except BaseException as error:  # noqa: BLE001 - every other exception is what this program looks for
        where = traceback.extract_tb(error.__traceback__)[-1]
        words = NUMBER.sub("#", str(error))[:200]  # one kind of finding, whatever the numbers
        return "finding", f"{type(error).__name__}: {words} ({Path(where.filename).name}:{where.lineno})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def too_slow(signal_number, frame):  # noqa: ARG001 - the signature of a handler
    raise TooSlowError


def limit_memory():
    """Bound the address space of this process; return its resident bytes now."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + ADDRESS_SPACE_ABOVE_START
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return resident_bytes()


def resident_bytes():
    """Return the largest resident size so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def saved(target, args, number, data, what, seeds):
    """Make a finding smaller and write it; return what to print."""
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{target.name}-seed{args.seed}-case{number}{target.suffix}"
    path.write_bytes(minimised(target, data, what, seeds))
    return {"case": number, "what": what, "path": str(path)}


def minimised(target, data, what, seeds):
    """Return the simplest file found with the same finding."""
    if what.startswith(("more than", "resident")) or " holds " in what:
        return data
    candidates = target.smaller(data, seeds)
    try:
        candidate = next(candidates)
        while True:
            same = attempt(target, candidate)[1] == what
            data = candidate if same else data
            candidate = candidates.send(candidate if same else None)
    except StopIteration:
        return data


if __name__ == "__main__":
    sys.exit(main())
