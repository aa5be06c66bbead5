"""Check and measure the compiled refit step."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import csplat
from csplat.types import F32, F64
from csplat_bench.scenes import SAMPLE
from csplat_render import Camera
from csplat_render.camera import intrinsics
from csplat_render.virtual_cameras import virtual_cameras
from csplat_trainer.parameters import ParameterArrays
from native_step.refit_steps import (
    GROUPS,
    PHASES,
    CompiledRefit,
    NumbaRefit,
    StepInputs,
    available_compilers,
    available_sets,
    build,
    disturbed_values,
    timed_numba_phases,
)

# Limits of differences between two renderers in float32. Where an alpha or a transmittance is within rounding of its
# minimum, they may decide differently. This changes the pixel by about 1/255 of a colour, and the gradients
# of its splats.
_IMAGE = 1e-5  # largest difference of a pixel without such a decision
_UNEQUAL_PIXELS = 2e-4  # largest fraction of pixels with one
_DECISION = 1e-2  # largest difference of such a pixel
_GRADIENT = 1e-2  # relative to the largest of the group
# The same, in images without such pixels. Gradients of the shape of a single small splat cancel: with numba, float32
# differs from float64 by 3e-4.
_EDGE_GRADIENT = 1e-3
_ERROR = 1e-6  # largest relative difference from the squared error in float64 of the library's own image

_CHECK_LENGTH, _BENCH_LENGTH = 0.02, 1e-4  # root mean square errors; short steps hardly change the measured scene

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, help=__doc__)

_Scenes = Annotated[list[Path], typer.Argument(metavar="[SCENE.ply]…", help="Scenes. Default: the sample scene.")]
_Compilers = Annotated[list[str], typer.Option("--compiler", help="May be repeated. Default: GCC and Clang.")]
_Sets = Annotated[list[str], typer.Option("--set", help="avx2 or avx512; may be repeated. Default: the machine's.")]


@app.command()
def check(scenes: _Scenes = [], compilers: _Compilers = [], sets: _Sets = []) -> None:
    """Compare images, gradients and steps with csplat_render, also for odd inputs; status 1 beyond the limits."""
    failures = 0
    libraries = _libraries(compilers, sets)
    for inputs in map(StepInputs.of, scenes or [SAMPLE]):
        for name, library in libraries.items():
            for line, passed in _check_scene(inputs, library):
                print(f"{inputs.name} {name} {line}{'' if passed else ' FAILED'}", flush=True)
                failures += not passed
    for name, library in libraries.items():
        for line, passed in _check_edges(library):
            print(f"edges {name} {line}{'' if passed else ' FAILED'}", flush=True)
            failures += not passed
    raise typer.Exit(failures > 0)


@app.command()
def hashes(scenes: _Scenes = [], compilers: _Compilers = [], sets: _Sets = []) -> None:
    """Print hashes of images, gradients and stepped values for 1, 2 and 8 threads; status 1 if they differ."""
    unequal = False
    libraries = _libraries(compilers, sets)
    for inputs in (StepInputs.of(path, views=3) for path in scenes or [SAMPLE]):
        found = set()
        for name, library in libraries.items():
            for threads in (1, 2, 8):
                result = hashes_of(inputs, library, threads)
                found.add(result)
                line = "image {} gradients {} values after steps {}".format(*result)
                print(f"{inputs.name}, {name}, threads {threads}: {line}", flush=True)
        unequal |= len(found) > 1
    raise typer.Exit(unequal)


@app.command()
def bench(
    scenes: _Scenes = [],
    compilers: _Compilers = [],
    sets: _Sets = [],
    *,
    threads: Annotated[int, typer.Option(help="Number of threads.")] = 1,
    runs: Annotated[int, typer.Option(help="Number of runs of each kind, which alternate.")] = 15,
) -> None:
    """Measure a step on 240x180 pixels, as medians of runs over the views that alternate with numba's."""
    libraries = _libraries(compilers, sets)
    for inputs in map(StepInputs.of, scenes or [SAMPLE]):
        print(f"{inputs.name}, {len(inputs.values['means'])} splats, {len(inputs.cameras)} views, threads {threads}")
        _bench_scene(inputs, libraries, threads, runs)


def hashes_of(inputs: StepInputs, library: Path, threads: int) -> tuple[str, str, str]:
    """Return hashes of all images, of all gradients and errors, and of the values after a step on each view."""
    image, slopes, values = (hashlib.sha256() for _ in range(3))
    refit = CompiledRefit(library, inputs.values, threads)
    for camera, reference in zip(inputs.cameras, inputs.references, strict=True):
        error, rgb, gradients = refit.gradients(camera, reference)
        assert np.array_equal(rgb, refit.render(camera))
        image.update(rgb.tobytes())
        slopes.update(_bytes_of(gradients) + np.float64(error).tobytes())
    for camera, reference in zip(inputs.cameras, inputs.references, strict=True):
        refit.step(camera, reference, _CHECK_LENGTH)
    values.update(_bytes_of(refit.values))
    return image.hexdigest()[:12], slopes.hexdigest()[:12], values.hexdigest()[:12]


def _bytes_of(groups: ParameterArrays) -> bytes:
    return b"".join(groups[name].tobytes() for name in GROUPS)


def _libraries(compilers: Sequence[str], sets: Sequence[str]) -> dict[str, Path]:
    """Build the libraries, and return them by the names of compiler and instruction set."""
    compilers, sets = compilers or available_compilers(), sets or available_sets()
    if not compilers or not sets:
        raise typer.BadParameter("building takes a C++ compiler, and running an x86-64 processor with AVX2, on Linux")
    return {f"{compiler} {name}": build(compiler, name) for compiler in compilers for name in sets}


def _check_scene(inputs: StepInputs, library: Path) -> Iterable[tuple[str, bool]]:
    ours, theirs = CompiledRefit(library, inputs.values), NumbaRefit(inputs.values)
    worst = dict.fromkeys(GROUPS, 0.0)
    for view, (camera, reference) in enumerate(zip(inputs.cameras, inputs.references, strict=True)):
        error, image, gradients = ours.gradients(camera, reference)
        expected_error, expected_image, expected = theirs.gradients(camera, reference)
        for name, difference in relative_differences(gradients, expected).items():
            worst[name] = max(worst[name], difference)
        difference = np.abs(image - expected_image).max(axis=2)
        unequal = np.count_nonzero(difference > _IMAGE)
        exact = np.sum(np.square(np.clip(image, 0.0, 1.0) - np.clip(reference, 0.0, 1.0), dtype=np.float64))
        passed = unequal <= _UNEQUAL_PIXELS * difference.size and difference.max() <= _DECISION
        yield (
            f"view {view}: image differs by {difference.max():.1e}, median {np.median(difference):.1e}, in {unequal} "
            f"pixels by more than {_IMAGE:g}; squared error {error:.5f} for {expected_error:.5f}; "
            "drawn {} for {}, pairs {} for {}".format(*np.ravel([ours.counts, theirs.counts], "F")),
            bool(passed and abs(error - exact) <= _ERROR * exact),
        )
    yield f"gradients differ by {_listed(worst)} of the largest", max(worst.values()) <= _GRADIENT
    yield _check_steps(inputs, ours, theirs)


def _check_steps(inputs: StepInputs, ours: CompiledRefit, theirs: NumbaRefit) -> tuple[str, bool]:
    error = expected = 0.0
    for camera, reference in zip(inputs.cameras, inputs.references, strict=True):
        error = ours.step(camera, reference, _CHECK_LENGTH)
        expected = theirs.step(camera, reference, _CHECK_LENGTH)
    values, expected_values = ours.values, theirs.values
    apart = {
        name: _rms(values[name] - expected_values[name]) / _rms(inputs.values[name] - expected_values[name])
        for name in GROUPS
        if values[name].size
    }
    line = f"after {len(inputs.cameras)} steps: squared error {error:.5f} for {expected:.5f}, "
    return line + f"values differ by {_listed(apart)} of their moves", abs(error - expected) <= 1e-3 * expected


def _check_edges(library: Path) -> Iterable[tuple[str, bool]]:
    """Compare no splat, one, and many with NaN and extremes, on odd image sizes, for each SH degree."""
    model = csplat.read(SAMPLE)
    pose = virtual_cameras(model, 1, 240, 180)[0]
    every = disturbed_values(model)
    background = np.array([0.2, 0.5, 0.9], np.float32)
    for degree in range(4):
        for count, width, height in ((0, 17, 5), (1, 16, 16), (37, 33, 17), (5000, 63, 47)):
            values = {name: array[:count].copy() for name, array in every.items()}
            values["shN"] = np.ascontiguousarray(values["shN"][:, : (degree + 1) ** 2 - 1])
            if count > 15:
                _spoil(values)
            camera = Camera(intrinsics(width, height, 40.0), pose.viewmat, width, height, pose.near)
            reference = np.full((height, width, 3), 0.4, np.float32)
            ours = CompiledRefit(library, values, 2, background)
            with np.errstate(all="ignore"):
                _, expected_image, expected = NumbaRefit(values, 1, background).gradients(camera, reference)
                _, image, gradients = ours.gradients(camera, reference)
                apart = relative_differences(gradients, expected)
                difference = np.abs(image - expected_image).max()
                ours.step(camera, reference, _CHECK_LENGTH)
            passed = difference <= _IMAGE and max(apart.values()) <= _EDGE_GRADIENT
            line = f"degree {degree}, {count} splats, {width}x{height}: {ours.counts[0]} drawn, image differs by "
            yield f"{line}{difference:.1e}, gradients by {_listed(apart)}", bool(passed)


def _spoil(values: ParameterArrays) -> None:
    """Give some splats values that are not finite, or extreme."""
    values["means"][3] = np.nan
    values["scales"][5, 1] = np.inf
    values["sh0"][7, 0] = np.nan
    values["quats"][9] = 0.0
    values["scales"][11] = 3.0
    values["logits"][13] = 30.0
    values["scales"][15] = -90.0


def relative_differences(gradients: ParameterArrays, expected: ParameterArrays) -> dict[str, float]:
    """Return each group's largest difference, relative to its largest expected gradient."""
    return {
        name: float(_largest(gradients[name] - expected[name]) / max(_largest(expected[name]), 1e-30))
        for name in GROUPS
    }


def _largest(array: F32) -> float:
    return float(np.abs(array).max(initial=0.0))


def _rms(array: F32) -> float:
    return float(np.sqrt(np.mean(np.square(array, dtype=np.float64))))


def _listed(numbers: dict[str, float]) -> str:
    return ", ".join(f"{name} {number:.1e}" for name, number in numbers.items())


def _bench_scene(inputs: StepInputs, libraries: dict[str, Path], threads: int, runs: int) -> None:
    numba = NumbaRefit(inputs.values, threads)
    compiled = {name: CompiledRefit(library, inputs.values, threads) for name, library in libraries.items()}
    steps: dict[str, Callable[[Camera, F32, float], float]] = {"numba": numba.step}
    steps |= {name: refit.step for name, refit in compiled.items()}
    views = list(zip(inputs.cameras, inputs.references, strict=True))
    measured: dict[str, list[list[float]]] = {name: [] for name in steps}  # wall, CPU, phases: ms per step
    with timed_numba_phases() as numba_seconds:
        for run in range(-1, runs):  # the first compiles numba's kernels, and is not counted
            for name, step in steps.items():
                numba_seconds.update(dict.fromkeys(PHASES, 0.0))
                if name in compiled:
                    compiled[name].phase_seconds()
                wall, processor = time.perf_counter(), time.process_time()
                for camera, reference in views:
                    step(camera, reference, _BENCH_LENGTH)
                wall, processor = time.perf_counter() - wall, time.process_time() - processor
                phases = compiled[name].phase_seconds() if name in compiled else numba_seconds.values()
                if run >= 0:
                    measured[name].append([1e3 * seconds / len(views) for seconds in (wall, processor, *phases)])
    _print_medians({name: np.array(rows) for name, rows in measured.items()})


def _print_medians(measured: dict[str, F64]) -> None:
    print("| | ms | least | CPU ms | ratio | ratio of pairs | " + " | ".join(PHASES) + " |\n" + "|---" * 10 + "|")
    numba = measured["numba"]
    for name, rows in measured.items():
        wall, processor, *phases = np.median(rows, axis=0)
        ratio, paired = np.median(numba[:, 0]) / wall, np.median(numba[:, 0] / rows[:, 0])
        cells = [f"{wall:.1f}", f"{rows[:, 0].min():.1f}", f"{processor:.1f}", f"{ratio:.2f}", f"{paired:.2f}"]
        print(f"| {name} | " + " | ".join(cells + [f"{phase:.1f}" for phase in phases]) + " |", flush=True)


if __name__ == "__main__":
    app()
