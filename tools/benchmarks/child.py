"""One measurement in a process of its own: `child.py encode|decode FILE ...` prints one line of JSON.

Peak growth is the process's largest resident size during the call, less its size before: on Linux the kernel's high-
water mark is reset before the call; elsewhere what `ru_maxrss` gained is a lower bound.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["peak_bytes", "reset_peak"]

_PROC = Path("/proc/self")


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("encode", "decode"))
    parser.add_argument("path", type=Path)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--threads", type=int)
    args = parser.parse_args()
    measure = {"encode": _encode, "decode": _decode}[args.what]
    json.dump(measure(args), sys.stdout)


def _encode(args: argparse.Namespace) -> dict[str, Any]:
    from csplat.encoder import EncodeOptions, encode_with_report
    from csplat.ply import read_ply

    model = read_ply(args.path)
    options = EncodeOptions(preset=args.preset, threads=args.threads)
    result, seconds, growth = _run(lambda: encode_with_report(model, options), args.runs)
    if args.output is not None:
        args.output.write_bytes(result.data)
    return {
        "seconds": seconds,
        "growth_bytes": growth,
        "array_bytes": _array_bytes(model),
        "size_bytes": len(result.data),
        "errors": {name: {"max": pair[0], "rms": pair[1]} for name, pair in result.report.errors.items()},
    }


def _decode(args: argparse.Namespace) -> dict[str, Any]:
    from csplat.decoder import decode

    data = args.path.read_bytes()
    model, seconds, growth = _run(lambda: decode(data), args.runs)
    return {"seconds": seconds, "growth_bytes": growth, "array_bytes": _array_bytes(model), "size_bytes": len(data)}


def _run(call: Callable[[], Any], runs: int) -> tuple[Any, float, int]:
    """Return the last result, the median of the seconds, and what the first call made the process grow by."""
    gc.collect()
    before = reset_peak()
    seconds, growth, result = [], 0, None
    for run in range(runs):
        result = None  # the next call does not find the memory taken
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
        if run == 0:
            growth = peak_bytes() - before
    return result, statistics.median(seconds), growth


def _array_bytes(model: Any) -> int:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return sum(getattr(model, name).nbytes for name in names)


def reset_peak() -> int:
    """Reset the high-water mark where the kernel allows it; return the size before the call."""
    with contextlib.suppress(OSError):
        (_PROC / "clear_refs").write_text("5")
        resident = _status("VmRSS")
        if resident is not None and _status("VmHWM") is not None:
            return resident
    return _max_rss()


def peak_bytes() -> int:
    """Largest resident size since the mark was reset, or ever where it cannot be."""
    peak = _status("VmHWM")
    return _max_rss() if peak is None else peak


def _status(key: str) -> int | None:
    with contextlib.suppress(OSError):
        for line in (_PROC / "status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return int(value.split()[0]) * 1024
    return None


def _max_rss() -> int:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


if __name__ == "__main__":
    main()
