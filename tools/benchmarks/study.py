"""Repeat a published study of simple strategies: fewer SH bands, opacity pruning, k-means; and what it left to do.

    python tools/benchmarks/study.py                        # everything: about half an hour on two cores
    python tools/benchmarks/study.py baseline --markdown    # the published rows and the first of the others
    python tools/benchmarks/study.py tables claims plots    # what is known already, and the plots of tools/STUDY.md
    python tools/benchmarks/study.py baseline --iterations 200 --views 10 --out out/quick

The baseline is trained first: Lego at 200×200, 1,000 splats from first to last, SH degree 1, 7,000 iterations, white
background. The splats start at random in the scene's box and nothing moves, adds or removes any. Figures are means and
standard deviations over the 200 test views. Sizes are those of the published rule (raw float32, or codebooks in float32
and indices of ceil(log2 K) bits; MiB) and those of .csplat files. What was measured is kept in out/study/NAME.json, and
measured once. A baseline with LPIPS in its loss wants torch.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from compression_scenes import Kept, Scene, file_digest
from machine import describe_machine
from scenes import DATA, ROOT
from study_claims import claims, format_claims
from study_judge import Distance
from study_plots import draw
from study_rows import (
    Row,
    attribute_bytes,
    baseline_bytes,
    measure_row,
    measure_taus,
    rows_of_baseline,
    rows_of_render,
    rows_of_scene,
)
from study_scenes import BASELINES, OTHERS, OWN, RENDERED, Subject, baselines, larger, open_subject
from study_tables import tables

from csplat.errors import CsplatError, InputError
from csplat.files import atomic_writer
from csplat_render.lpips import load_lpips
from csplat_render.warmup import warm_up

_FIRST = "study1k"
_PARTS = ("baseline", "variants", "scenes", "renders", "lpips")
_LAST = "study1k-lpips"

Rows = Callable[[Subject], list[Row]]


def main(words: list[str] | None = None) -> int:
    """Measure what the command line names; print tables and claims, draw plots.

    Args:
        words: the command line without its first word; `None`: the process's.

    Returns:
        0: done; 1: a scene or file cannot be used; the others are measured all the same.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # threads that wait for each other sleep soon, see `csplat train`
    parser = _parser()
    args = parser.parse_args(words)
    unknown = set(args.what) - {*_PARTS, "tables", "claims", "plots"}
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))} cannot be measured, wanted some of {', '.join(_PARTS)}")
    done = True
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        parts = [part for part in _PARTS if part in args.what or not args.what]
        if parts:
            done = _measure(parts, args)
        _show(args)
    except (CsplatError, OSError) as error:
        _tell(f"error: {error}")
        return 1
    return 0 if done else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shown = f"{', '.join(_PARTS)}; or tables, claims, plots of what is known; default: all"
    parser.add_argument("what", nargs="*", metavar="WHAT", help=shown)
    parser.add_argument("--scenes", default=",".join((*OTHERS, *OWN)), help="beside the baseline; default: %(default)s")
    parser.add_argument("--iterations", type=int, default=7000, help="of the baseline; default: %(default)s")
    parser.add_argument("--splats", type=int, default=1000, help="of the baseline; default: %(default)s")
    parser.add_argument("--views", type=int, default=0, metavar="N", help="test views at most; default: all")
    parser.add_argument(
        "--lpips", metavar="FILE", default=str(DATA / "lpips" / "lpips_alex.npz"),
        help="weights of LPIPS-Alex, auto for the usual places, none to leave it out; default: the data folder's",
    )  # fmt: skip
    parser.add_argument("--markdown", action="store_true", help="print tables as documents have them")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "study", help="default: %(default)s")
    parser.add_argument("--plots", type=Path, default=ROOT / "tools" / "study", help="default: %(default)s")
    return parser


def _measure(parts: list[str], args: argparse.Namespace) -> bool:
    """Measure; return whether all went well."""
    lpips = _lpips(args.lpips)
    names = [name for name in args.scenes.split(",") if name]
    unknown = set(names) - {*OTHERS, *OWN}
    if unknown:
        raise InputError(
            f"no scene is called {', '.join(sorted(unknown))}, wanted some of {', '.join((*OTHERS, *OWN))}"
        )
    known = baselines(args.iterations, args.splats)
    warm_up(_tell, simplify=True, ssim=True, lpips=lpips is not None)
    jobs: list[tuple[str, str, Rows]] = [("baseline", _FIRST, lambda _: rows_of_baseline())]
    jobs += [("variants", name, rows_of_scene) for name in BASELINES if name not in (_FIRST, _LAST)]
    jobs += [("scenes", name, rows_of_scene) for name in names]
    jobs += [("renders", f"{_FIRST}@{width}", lambda _: rows_of_render()) for width in RENDERED]
    jobs += [("lpips", _LAST, rows_of_scene)]
    done = True
    for part, name, rows in jobs:
        if part in parts:
            try:
                _subject(name, rows, known, lpips, args)
            except (CsplatError, OSError) as error:  # the others are measured all the same
                _tell(f"error: {error}")
                done = False
    return done


def _lpips(text: str) -> Distance | None:
    if text == "none":
        return None
    weights = load_lpips(None if text == "auto" else text)
    if text != "auto":
        os.environ["CSPLAT_LPIPS"] = text  # where training looks for them
    return weights


def _subject(name: str, rows: Rows, known: dict[str, Scene], lpips: Distance | None, args: argparse.Namespace) -> None:
    """Measure the lines of a scene that are not known yet."""
    base, _, width = name.partition("@")
    subject = open_subject(base, known, args.out, lpips, _tell, args.views)
    if width:
        count = min(len(subject.views.cameras), RENDERED[int(width)])
        subject = larger(subject, int(width), count)
    settings = {
        "ply_sha256": file_digest(subject.ply), "judged_by": subject.judged_by, "lpips": lpips is not None,
    }  # fmt: skip
    kept = Kept(args.out / f"{name}.json", settings, _tell)
    kept.values["machine"] = describe_machine(("numpy", "numba", "deflate"))
    kept.values["facts"] = _facts(subject)
    wanted = rows(subject)
    for row in wanted:
        if kept.knows("rows", row.name) and kept.values["rows"][row.name]["how"] != row.how:
            del kept.values["rows"][row.name]  # it has been told otherwise since
        kept.measure("rows", row.name, partial(measure_row, subject, row))
    kept.values["order"] = [row.name for row in wanted]
    if not width:
        kept.measure("taus", "all", partial(measure_taus, subject.source, subject.views))
        kept.measure("attributes", "all", partial(attribute_bytes, subject))
    _write(kept.path, kept.values)


def _facts(subject: Subject) -> dict[str, Any]:
    training = subject.training
    return {
        "splats": len(subject.source),
        "sh_degree": subject.source.sh_degree,
        "bytes": baseline_bytes(subject.source),
        "judged_by": subject.judged_by,
        "how": BASELINES.get(subject.name),
        "training_seconds": training.get("seconds"),
        "training": training.get("options"),
    }


def _show(args: argparse.Namespace) -> None:
    """Print what is known, and draw it."""
    what = args.what or [*_PARTS, "claims", "plots"]
    order = [_FIRST, *(f"{_FIRST}@{width}" for width in RENDERED), *BASELINES, *OTHERS, *OWN]
    paths = {name: args.out / f"{name}.json" for name in dict.fromkeys(order)}
    results = {name: json.loads(path.read_text()) for name, path in paths.items() if path.exists()}
    results = {name: one for name, one in results.items() if "order" in one}
    if set(what) - {"claims", "plots"}:
        print(tables(results, markdown=args.markdown))
    if "claims" in what:
        found = claims(results)
        _write(args.out / "claims.json", found)
        print("\n" + format_claims(found, markdown=args.markdown))
    for machine in sorted({tuple(one["machine"].items()) for one in results.values()}):
        print("\n" + "\n".join(f"{key}: {value}" for key, value in machine))
    if "plots" in what:
        args.plots.mkdir(parents=True, exist_ok=True)
        for path in draw(results, args.plots):
            _tell(f"drawn: {path}")


def _write(path: Path, document: dict[str, Any]) -> None:
    with atomic_writer(path) as stream:
        stream.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
