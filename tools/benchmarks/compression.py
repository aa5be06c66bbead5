"""Measure a whole compression of trained scenes, step by step, on the photographs that were held out.

    python tools/benchmarks/compression.py main control --scenes lego20k       # the file, its ablation, the control
    python tools/benchmarks/compression.py --lpips alex.npz                    # everything: hours
    python tools/benchmarks/compression.py curve --scenes fox120k --keep 0.8,0.6,0.4
    python tools/benchmarks/compression.py main --scenes lego50k --knob escape_fraction=0.12 --out out/finer
    python tools/benchmarks/compression.py main --scenes '' --extra NAME scene.ply photographs 640x480 black
    python tools/benchmarks/compression.py memory --memory 100000,500000
    python tools/benchmarks/compression.py tables --markdown

A compression is what `csplat finetune` does: sensitivities from the training views, codebooks
of SH and shapes, fine-tuning through the encoder's quantisers. Scores are those of the decoded files, ratios those to
a PLY of 62 floats. What was measured is kept scene by scene in out/compression/NAME.json. LPIPS is AlexNet's.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any

from compression_jobs import Ways, facts_of, find_jobs, find_ways, warm
from compression_memory import measure_memory
from compression_runs import Bench
from compression_scenes import SCENES, Kept, Scene, choose_scenes, file_digest, trained
from compression_tables import plot_curve, tables
from machine import describe_machine
from scenes import ROOT

from csplat.encoder import PRESETS, EncodeOptions
from csplat.errors import CsplatError, InputError
from csplat_render.jit import thread_count
from csplat_render.lpips import Lpips, load_lpips
from csplat_render.warmup import warm_up
from csplat_trainer.finetune import FinetuneOptions

_PARTS = ("main", "control", "others", "sizes", "escapes", "positions", "sh0", "histogram", "curve", "memory")
_MEMORY = "peak-memory.json"
_MEMORY_STEPS = 30  # memory does not grow with them

_OWN = ("attribute_psnr", "codebook_size", "shape_codebook_size", "threads")  # of the encoder's options

_LISTS: tuple[tuple[str, type[int | float] | None, str, str], ...] = (
    ("sizes", int, "1024,2048,4096,8192,16384", "of codebooks"),
    ("escapes", float, "0,0.01,0.02,0.05,0.1,0.2", "shares"),
    ("bits", int, "16,14,12,10", "of positions, per axis"),
    ("keep", float, "0.8,0.6,0.5,0.4", "shares of the splats, for the curve"),
    ("qualities", float, "46,43,40", "coarser files for the curve, dB"),
    ("both", None, "0.6:46,0.6:43,0.4:46", "shares and dB for the curve"),
    ("memory", int, "100000,500000", "splats"),
)

How = tuple[EncodeOptions, FinetuneOptions, Ways]


def main(words: list[str] | None = None) -> int:
    """Measure what the command line names, and print all that is known.

    Args:
        words: the command line without its first word; `None`: the process's.

    Returns:
        0: done; 1: a scene or file cannot be used.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # threads that wait for each other sleep soon, see `csplat train`
    parser = _parser()
    args = parser.parse_args(words)
    unknown = set(args.what) - {*_PARTS, "tables"}
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))} cannot be measured, wanted some of {', '.join(_PARTS)}, or tables")
    try:
        encoding, tuning = _options(args)
        ways = find_ways(args, encoding)
    except InputError as error:
        parser.error(str(error))
    done = True
    try:
        if set(args.what) != {"tables"}:
            args.out.mkdir(parents=True, exist_ok=True)
            done = _measure(args, encoding, tuning, ways)
        _print(args)
    except (CsplatError, OSError) as error:
        _tell(f"error: {error}")
        return 1
    return 0 if done else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"{', '.join(_PARTS)}, or tables alone; default: all")
    parser.add_argument("--scenes", default=",".join(SCENES), help="names, separated by commas; default: %(default)s")
    parser.add_argument("--ply", action="append", default=[], metavar="NAME=FILE", help="splats, instead of training")
    parser.add_argument(
        "--extra", nargs=4, action="append", default=[], metavar=("NAME", "PLY", "DATA", "WxH"),
        help="a further scene; WxH may be -",
    )  # fmt: skip
    parser.add_argument(
        "--train-iterations", type=int, metavar="N", help="of scenes that are trained; default: each its own"
    )
    parser.add_argument("--preset", choices=list(PRESETS), default="small", help="default: %(default)s")
    parser.add_argument("--attribute-psnr", type=float, metavar="DB", help="of the encoder; default: the preset's")
    parser.add_argument("--codebook-size", type=int, metavar="N", help="of SH; default: what the encoder chooses")
    parser.add_argument(
        "--knob", action="append", default=[], metavar="NAME=NUMBER", help="any other option of the encoder"
    )
    parser.add_argument(
        "--shapes", type=int, default=4096, help="their codebook at most; 0: none; default: %(default)s"
    )
    parser.add_argument(
        "--iterations",
        type=int,
        default=FinetuneOptions().iterations,
        metavar="N",
        help="of tuning; default: %(default)s",
    )
    parser.add_argument(
        "--byte-cost", type=float, default=FinetuneOptions().byte_cost, help="in the loss; default: %(default)s"
    )
    parser.add_argument("--lr-factor", type=float, default=1.0, help="of all learning rates; default: %(default)s")
    for name, kind, default, words in _LISTS:
        parser.add_argument(f"--{name}", type=_numbers(kind), default=default, help=f"{words}; default: %(default)s")
    parser.add_argument("--memory-scene", default="fox120k", help="what they are made of; default: %(default)s")
    parser.add_argument("--lpips", metavar="FILE", help="weights of LPIPS-Alex, or auto for the usual places")
    parser.add_argument("--threads", type=int, help="one per core by default")
    parser.add_argument("--markdown", action="store_true", help="print tables as documents have them")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "compression", help="default: %(default)s")
    return parser


def _options(args: argparse.Namespace) -> tuple[EncodeOptions, FinetuneOptions]:
    for share in (*args.keep, *(share for share, _ in args.both)):
        if not 0.0 < share <= 1.0:
            raise InputError(f"a share of splats is {share:g}, wanted more than 0, at most 1")
    encoding = EncodeOptions(
        preset=args.preset, attribute_psnr=args.attribute_psnr, codebook_size=args.codebook_size,
        shape_codebook_size=args.shapes or None, threads=args.threads, **_knobs(args.knob),
    )  # fmt: skip
    return encoding, FinetuneOptions(iterations=args.iterations, byte_cost=args.byte_cost).scaled(args.lr_factor)


def _knobs(words: list[str]) -> dict[str, Any]:
    """Options of the encoder by name, as NAME=NUMBER.

    Raises:
        InputError: there is no such option, or it takes no number.
    """
    known = {field.name: field.type for field in fields(EncodeOptions)}
    found: dict[str, Any] = {}
    for word in words:
        name, _, number = word.partition("=")
        kind = "" if name in _OWN else str(known.get(name, ""))
        if not kind.startswith(("int", "float")):
            raise InputError(f"--knob {word}: no other option of the encoder is called {name!r} and is a number")
        try:
            found[name] = int(number) if kind.startswith("int") else float(number)
        except ValueError:
            raise InputError(f"--knob {word}: {number!r} is no number for {name}") from None
    return found


def _numbers(kind: type[int | float] | None) -> Callable[[str], tuple[Any, ...]]:
    """A reader of numbers between commas; `None`: of pairs of them, a colon between the two."""

    def numbers(text: str) -> tuple[Any, ...]:
        words = [word for word in text.split(",") if word]
        if kind is not None:
            return tuple(kind(word) for word in words)
        pairs = [word.split(":") for word in words]
        return tuple((float(one), float(other)) for one, other in pairs)

    return numbers


def _measure(args: argparse.Namespace, encoding: EncodeOptions, tuning: FinetuneOptions, ways: Ways) -> bool:
    """Measure; return whether all went well."""
    names = [name for name in args.scenes.split(",") if name]
    scenes = choose_scenes(names, args.ply, args.extra, args.train_iterations)
    lpips = None if args.lpips is None else load_lpips(None if args.lpips == "auto" else args.lpips)
    what, done = args.what or _PARTS, True
    machine = describe_machine(("numpy", "numba", "deflate"))
    for key, value in machine.items():
        _tell(f"{key}: {value}")
    warm_up(_tell, simplify=True, ssim=True, lpips=lpips is not None)
    with thread_count(args.threads):
        for scene in scenes if set(what) - {"memory", "tables"} else []:
            try:
                _scene(scene, (encoding, tuning, ways), lpips, machine, args)
            except (CsplatError, OSError) as error:  # the others are measured all the same
                _tell(f"error: {scene.name}: {error}")
                done = False
    if "memory" in what:
        _memory(args)  # of the command as it is: what the encoder is told hardly matters
    return done


def _scene(scene: Scene, how: How, lpips: Lpips | None, machine: dict[str, str], args: argparse.Namespace) -> None:
    """Measure what is wanted of a scene and not known yet."""
    encoding, tuning, ways = how
    what = args.what or _PARTS
    ply, training = trained(scene, args.out, _tell)
    kept = Kept(args.out / f"{scene.name}.json", _settings(scene, ply, encoding, tuning, args), _tell)
    kept.values["machine"] = machine
    bench = Bench(scene, ply, encoding, tuning, lpips)
    kept.measure("facts", "scene", partial(facts_of, bench, training))
    jobs = [job for job in find_jobs(bench, kept, ways, args) if job[0] in what and not kept.knows(*job[:2])]
    if jobs:
        warm(bench)
    for kind, name, call in jobs:
        kept.measure(kind, name, call)


def _settings(
    scene: Scene, ply: Path, encoding: EncodeOptions, tuning: FinetuneOptions, args: argparse.Namespace
) -> dict[str, Any]:
    """All that results depend on."""
    settings = {
        "ply_sha256": file_digest(ply),
        "size": scene.size,
        "background": scene.background,
        "encoding": encoding.chosen(),
        "tuning": asdict(tuning),
        "lpips": args.lpips is not None,
    }
    document: dict[str, Any] = json.loads(json.dumps(settings))  # as it will be read again
    return document


def _memory(args: argparse.Namespace) -> None:
    scene = choose_scenes([args.memory_scene], args.ply, [], args.train_iterations)[0]
    ply, _ = trained(scene, args.out, _tell)
    settings = {"scene": args.memory_scene, "preset": args.preset, "shapes": args.shapes}
    kept = Kept(args.out / _MEMORY, settings, _tell)
    kept.values["machine"] = describe_machine(("numpy", "numba", "deflate"))
    words = ["--data", str(scene.data), "--iterations", str(_MEMORY_STEPS), "--preset", args.preset]
    words += ["--shape-codebook-size", str(args.shapes)]
    if scene.size is not None:
        words += ["--size", f"{scene.size[0]}x{scene.size[1]}"]
    for count in args.memory:
        kept.measure("memory", f"{count}", partial(measure_memory, ply, count, words, args.out))


def _print(args: argparse.Namespace) -> None:
    files = [path for path in sorted(args.out.glob("*.json")) if not path.name.endswith(".training.json")]
    known = {path.stem: json.loads(path.read_text()) for path in files}
    machines = {tuple(one["machine"].items()) for one in known.values()}
    memory = known.pop(Path(_MEMORY).stem, {}).get("memory")
    print(tables(known, memory, markdown=args.markdown))
    for machine in sorted(machines):
        print("\n" + "\n".join(f"{key}: {value}" for key, value in machine))
    picture = args.out / "curve.png"
    if plot_curve(known, picture):
        _tell(f"the curves are drawn in {picture}")


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
