"""Measure a whole compression of trained scenes, step by step, on the photographs that were held out.

    python -m csplat_bench.compression main control --scenes lego20k       # the file, its ablation, the control
    python -m csplat_bench.compression --lpips alex.npz                    # everything: hours
    python -m csplat_bench.compression curve --scenes fox120k --keep 0.8,0.6,0.4
    python -m csplat_bench.compression main --scenes lego50k --knob escape_fraction=0.12 --out out/finer
    python -m csplat_bench.compression main --scenes '' --extra NAME,scene.ply,photographs,640x480
    python -m csplat_bench.compression memory --memory 100000,500000
    python -m csplat_bench.compression tables --markdown

A compression is what `csplat finetune` does: sensitivities from the training views, codebooks
of SH and shapes, fine-tuning through the encoder's quantisers. Scores are those of the decoded files, ratios those to
a PLY of 62 floats. What was measured is kept scene by scene in out/compression/NAME.json. LPIPS is AlexNet's.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import CsplatError, InputError
from csplat_bench.common.captures import CAPTURES, Capture, choose_captures, trained
from csplat_bench.common.command import (
    LPIPS,
    MARKDOWN,
    OUT,
    SCENES,
    THREADS,
    WrongWords,
    listed,
    numbers,
    preset_of,
    run,
)
from csplat_bench.common.kept import Kept, file_digest, read_kept
from csplat_bench.common.report import machines, tell_machine
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.compression.jobs import KINDS, Lists, facts_of, find_jobs, variants, warm
from csplat_bench.compression.memory import measure_memory
from csplat_bench.compression.runs import Bench
from csplat_bench.compression.tables import tables
from csplat_render.kernels import thread_count
from csplat_render.lpips import load_lpips
from csplat_render.warmup import warm_up
from csplat_tools.console import note
from csplat_trainer.tuning import FinetuneOptions

_SCENES = ",".join(CAPTURES)
_PARTS = (*KINDS, "memory")
_WHAT = f"{', '.join(_PARTS)}; or tables alone; default: all"
_MEMORY = "peak-memory"
_MEMORY_STEPS = 30  # memory does not grow with them
_STEPS, _BYTE_COST = FinetuneOptions().iterations, FinetuneOptions().byte_cost


def main(
    what: Annotated[list[str], typer.Argument(metavar="WHAT", help=_WHAT)] = [],
    *,
    scenes: SCENES = _SCENES,
    extra: Annotated[list[str], typer.Option(metavar="NAME,PLY,DATA,WxH", help="a further scene; WxH may be -")] = [],
    preset: Annotated[str, typer.Option(help="of the encoder")] = "small",
    knob: Annotated[list[str], typer.Option(metavar="NAME=NUMBER", help="any other option of the encoder")] = [],
    iterations: Annotated[int, typer.Option(help="of tuning")] = _STEPS,
    byte_cost: Annotated[float, typer.Option(help="in the loss")] = _BYTE_COST,
    sizes: Annotated[str, typer.Option(help="of codebooks")] = "1024,2048,4096,8192,16384",
    escapes: Annotated[str, typer.Option(help="shares")] = "0,0.01,0.02,0.05,0.1,0.2",
    bits: Annotated[str, typer.Option(help="of positions, per axis")] = "16,14,12,10",
    keep: Annotated[str, typer.Option(help="shares of the splats, for the curve")] = "0.8,0.6,0.5,0.4",
    memory: Annotated[str, typer.Option(help="splats")] = "100000,500000",
    memory_scene: Annotated[str, typer.Option(help="what they are made of")] = "fox120k",
    lpips: LPIPS = None,
    threads: THREADS = None,
    markdown: MARKDOWN = False,
    out: OUT = EVERYTHING / "compression",
) -> int:
    """Measure what the command line names, and print all that is known."""
    unknown = set(what) - {*_PARTS, "tables"}
    if unknown:
        raise WrongWords(
            f"{', '.join(sorted(unknown))} cannot be measured, wanted some of {', '.join(_PARTS)}, or tables"
        )
    parts = [part for part in _PARTS if part in what or not what]
    lists = Lists(numbers(sizes, int), numbers(escapes, float), numbers(bits, int), numbers(keep, float))
    try:
        encoding = EncodeOptions(
            preset=preset_of(preset), threads=threads, **{"shape_codebook_size": 4096, **_knobs(knob)}
        )
        tuning = FinetuneOptions(iterations=iterations, byte_cost=byte_cost)
        variants(encoding, lists)
    except InputError as error:
        raise WrongWords(str(error)) from None
    if not all(0.0 < share <= 1.0 for share in lists.keep):
        raise WrongWords(f"a share of splats is to be more than 0, at most 1: --keep {keep}")
    failed = False
    if set(parts) & set(KINDS):
        chosen = choose_captures(listed(scenes), extra)
        warm_up(note, simplify=True, ssim=True, lpips=lpips is not None)
        with thread_count(threads):
            for one in chosen:
                try:
                    _measure(one, parts, lists, encoding, tuning, lpips, out)
                except (CsplatError, OSError) as error:  # the others are measured all the same
                    note(f"error: {one.name}: {error}")
                    failed = True
    if "memory" in parts:
        (scene,) = choose_captures([memory_scene])
        _measure_memory(scene, numbers(memory, int), preset, out)
    known = read_kept(out)
    print(tables(known, known.pop(_MEMORY, {}).get("memory"), markdown=markdown))
    print("\n" + machines(one["machine"] for one in known.values()))
    return int(failed)


def _knobs(words: Sequence[str]) -> dict[str, Any]:
    """Options of the encoder by name, as NAME=NUMBER.

    Raises:
        InputError: there is no such option, or it takes no number.
    """
    known, found = {field.name: str(field.type) for field in fields(EncodeOptions)}, {}
    for word in words:
        name, _, number = word.partition("=")
        kind = next((kind for kind in (int, float) if known.get(name, "").startswith(kind.__name__)), None)
        if kind is None:
            raise InputError(f"--knob {word}: no option of the encoder is called {name!r} and is a number")
        try:
            found[name] = kind(number)
        except ValueError:
            raise InputError(f"--knob {word}: {number!r} is no number for {name}") from None
    return found


def _measure(
    scene: Capture, parts: Sequence[str], lists: Lists, encoding: EncodeOptions, tuning: FinetuneOptions,
    lpips: str | None, out: Path,
) -> None:  # fmt: skip
    """Measure what is wanted of a scene and not known yet."""
    ply, training = trained(scene, out)
    settings = {  # all that results depend on
        "ply_sha256": file_digest(ply),
        "size": scene.size,
        "background": scene.background,
        "encoding": encoding.chosen(),
        "tuning": asdict(tuning),
        "lpips": lpips is not None,
    }
    kept = Kept(out / f"{scene.name}.json", settings)
    kept.values["machine"] = tell_machine()
    distance = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    bench = Bench(scene, ply, encoding, tuning, distance)
    kept.measure("facts", "scene", partial(facts_of, bench, training))
    jobs = [job for job in find_jobs(bench, kept, lists) if job[0] in parts and not kept.knows(*job[:2])]
    if jobs:
        warm(bench)
    for kind, name, call in jobs:
        kept.measure(kind, name, call)


def _measure_memory(scene: Capture, counts: Sequence[int], preset: str, out: Path) -> None:
    """Measure the peak memory of `csplat finetune` by number of splats, with default encoder options."""
    ply, _ = trained(scene, out)
    kept = Kept(out / f"{_MEMORY}.json", {"scene": scene.name, "preset": preset})
    kept.values["machine"] = tell_machine()
    words = ["--data", str(scene.data), "--iterations", str(_MEMORY_STEPS), "--preset", preset]
    words += [] if scene.size is None else ["--size", f"{scene.size[0]}x{scene.size[1]}"]
    for count in counts:
        kept.measure("memory", f"{count}", partial(measure_memory, ply, count, words))


if __name__ == "__main__":
    sys.exit(run(main))
