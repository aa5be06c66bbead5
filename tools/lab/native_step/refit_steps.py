"""Refit steps by the library in C++ (`CompiledRefit`) and by numba (`NumbaRefit`), and the inputs of both."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import csplat
from csplat.context import Context
from csplat.encoder.entropy import morton_codes
from csplat.model import SplatModel
from csplat.types import F32, F64
from csplat_render import Camera, rasteriser
from csplat_render.conventions import UncheckedSplats, view_vector
from csplat_render.virtual_cameras import virtual_cameras
from csplat_trainer import parameters as trainer_parameters
from csplat_trainer.parameters import ParameterArrays, Parameters, adam_step, from_model
from csplat_trainer.splat_refit import _BETA2, _RATES

_SOURCES = Path(__file__).resolve().parent
_ROOT = _SOURCES.parents[2]

#: Groups of values that a refit changes, in the order of the library's rows; means come before them.
GROUPS = ("quats", "scales", "logits", "sh0", "shN")

#: Parts of a step whose time is measured.
PHASES = ("projection", "binning", "blending and gradient", "gradient of projection and Adam")

#: Flags of the processor that each instruction set requires, as in /proc/cpuinfo.
_REQUIRED_FLAGS = {
    "avx2": "avx2 fma",
    "avx512": "avx2 fma bmi1 bmi2 f16c abm movbe avx512f avx512bw avx512cd avx512dq avx512vl",
}

_MORTON_TOP = (1 << 21) - 1  # largest coordinate of a Morton code

#: Functions of csplat_render.rasteriser and csplat_trainer.parameters in each phase.
_TIMED = (
    (rasteriser, PHASES[0], ("project",)),
    (
        rasteriser,
        PHASES[1],
        ("depth_order", "gather_by_depth", "count_tiles", "tile_starts", "record_offsets", "fill_tiles"),
    ),
    (rasteriser, PHASES[2], ("blend", "blend_backward")),
    (rasteriser, PHASES[3], ("project_backward",)),
    (trainer_parameters, PHASES[3], ("_adam", "_constrain")),
)


@dataclass(frozen=True, eq=False)
class StepInputs:
    """A scene whose values are disturbed, and renders of the undisturbed scene as references.

    Attributes:
        name: name of the scene.
        values: means and `GROUPS`, as `csplat_trainer.parameters.from_model`.
        cameras: the views.
        references: [H, W, 3], the reference image of each view.
    """

    name: str
    values: ParameterArrays
    cameras: Sequence[Camera]
    references: Sequence[F32]

    @classmethod
    def of(cls, path: Path, views: int = 6, width: int = 240, height: int = 180) -> StepInputs:
        """Read a scene, and render its references.

        Args:
            path: a PLY. Cameras are taken from `NAME.cameras.json` next to it, evenly spaced in the file, with the
                centre of the image as principal point; without the file they are virtual.
            views: number of views, at most.
            width, height: pixels.
        """
        model = csplat.read(path)
        listed = path.with_suffix(".cameras.json")
        if listed.exists():
            entries = json.loads(listed.read_text("utf-8"))
            chosen = entries[:: max(1, len(entries) // views)][:views]
            cameras = [_reframed(Camera.from_json(entry), width, height) for entry in chosen]
        else:
            cameras = virtual_cameras(model, views, width, height)
        renderer = rasteriser.Rasteriser(gradients=False, context=Context(threads=1))
        references = [renderer.forward(model, camera).rgb for camera in cameras]
        return cls(path.stem, disturbed_values(model), cameras, references)


def _reframed(camera: Camera, width: int, height: int) -> Camera:
    factor = width / camera.W
    K = np.array([[camera.K[0, 0] * factor, 0, width / 2], [0, camera.K[1, 1] * factor, height / 2], [0, 0, 1]])
    return replace(camera, K=K, W=width, H=height)


def disturbed_values(model: SplatModel) -> ParameterArrays:
    """Return a model's values with noise, which a refit can reduce."""
    values = from_model(model, model.sh_degree)
    rng = np.random.default_rng(0)
    for name, size in (("logits", 0.3), ("scales", 0.1), ("quats", 0.02), ("sh0", 0.1), ("shN", 0.02)):
        values[name] = (values[name] + size * rng.standard_normal(values[name].shape)).astype(np.float32)
    return values


def rates_of(length: float) -> dict[str, float]:
    """Return the learning rate of each group for a step of this length (a root mean square error, 0 to 1)."""
    return {name: _RATES[name] * length for name in GROUPS}


class NumbaRefit:
    """A refit by csplat_render and csplat_trainer.

    Args:
        values: see `StepInputs`; they are copied.
        threads: number of threads.
        background: red, green, blue behind the splats.
    """

    def __init__(self, values: ParameterArrays, threads: int = 1, background: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self._means, self._background = values["means"], background
        self._parameters = Parameters.starting_at({name: values[name].copy() for name in GROUPS})
        self._parameters.beta2 = _BETA2
        self._rasteriser = rasteriser.Rasteriser(context=Context(threads=threads))
        self.counts = (0, 0)  # drawn splats, and pairs of splat and tile, in the last view

    @property
    def values(self) -> ParameterArrays:
        """Values of the groups."""
        return self._parameters.values

    def gradients(self, camera: Camera, reference: F32) -> tuple[float, F32, ParameterArrays]:
        """Return the squared error of a view, its image, and the gradients of half the error.

        The next call overwrites the gradients.
        """
        values, opacities = self._parameters.values, self._parameters.alphas
        splats = UncheckedSplats(
            self._means, values["quats"], values["scales"], opacities, values["sh0"], values["shN"]
        )
        render = self._rasteriser.forward(splats, camera, background=self._background)
        self.counts = render.drawn, render.intersections
        error = np.clip(render.rgb, 0.0, 1.0) - np.clip(reference, 0.0, 1.0)
        slopes = self._rasteriser.backward(error)
        gradients = {name: getattr(slopes, name) for name in GROUPS if name != "logits"}
        gradients["logits"] = slopes.opacities * opacities * (np.float32(1.0) - opacities)
        return float(np.vdot(error, error)), render.rgb, gradients

    def step(self, camera: Camera, reference: F32, length: float) -> float:
        """Make a step of a length, and return the squared error of the view before."""
        error, _, gradients = self.gradients(camera, reference)
        adam_step(self._parameters, gradients, rates_of(length))
        return error


@contextmanager
def timed_numba_phases() -> Iterator[dict[str, float]]:
    """Measure the seconds of wall time that numba's kernels take in each phase: a dictionary that grows."""
    seconds = dict.fromkeys(PHASES, 0.0)

    def timed(function: Any, phase: str) -> Any:
        def call(*arguments: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            result = function(*arguments, **named)
            seconds[phase] += time.perf_counter() - begin
            return result

        return call

    before = [(module, name, getattr(module, name)) for module, _, names in _TIMED for name in names]
    try:
        for module, phase, names in _TIMED:
            for name in names:
                setattr(module, name, timed(getattr(module, name), phase))
        yield seconds
    finally:
        for module, name, function in before:
            setattr(module, name, function)


def available_sets() -> list[str]:
    """Return the instruction sets that the library can be built for and that this machine has."""
    info = Path("/proc/cpuinfo")
    if platform.machine() != "x86_64" or not info.exists():
        return []
    lines = [line for line in info.read_text("utf-8").splitlines() if line.startswith("flags")]
    flags = set(lines[0].split()) if lines else set()
    return [name for name, required in _REQUIRED_FLAGS.items() if flags.issuperset(required.split())]


def available_compilers() -> list[str]:
    """Return a GCC and a Clang, if present, otherwise the system's compiler."""
    clang = next((name for name in ("clang++", "clang++-14") if shutil.which(name)), "clang++")
    found = [name for name in ("g++", clang) if shutil.which(name)]
    return found or [name for name in ("c++",) if shutil.which(name)]


def build(compiler: str, instruction_set: str) -> Path:
    """Build the library in out/native_step, unless it is newer than its sources, and return its path.

    Raises:
        subprocess.CalledProcessError: the compiler failed; its output is on stderr.
    """
    folder = _ROOT / "out" / "native_step" / Path(compiler).name
    library = folder / f"libcsplat_refit_{instruction_set}.so"
    sources = [path for path in _SOURCES.iterdir() if path.suffix in (".cpp", ".h", ".sh")]
    if not library.exists() or library.stat().st_mtime < max(path.stat().st_mtime for path in sources):
        subprocess.run([_SOURCES / "build.sh", folder, compiler, instruction_set], check=True)
    return library


class CompiledRefit:
    """A refit by the library in C++, with the same methods as `NumbaRefit`.

    Args:
        library: see `build`. The processor must have its instruction set.
        values: see `StepInputs`; they are copied. SH of degree 0 to 3.
        threads: number of threads.
        background: red, green, blue behind the splats.

    Raises:
        MemoryError: there is not enough memory.
    """

    def __init__(
        self, library: Path, values: ParameterArrays, threads: int = 1, background: ArrayLike = (0.0, 0.0, 0.0)
    ) -> None:
        self._handle: int | None = None
        self._library = _load(library)
        self._background = np.asarray(background, np.float32)
        self._shapes = {name: values[name].shape for name in GROUPS}
        degree = {0: 0, 3: 1, 8: 2, 15: 3}[values["shN"].shape[1]]
        self._rows = _rows_of(values)
        order = _neighbour_order(values["means"])
        self._handle = self._library.csplat_refit_new(
            len(order), degree, _address(self._rows), _address(order, np.int32), threads
        )
        if self._handle is None:
            raise MemoryError("the library has not enough memory for the splats")

    def __del__(self) -> None:
        if self._handle is not None:
            self._library.csplat_refit_free(self._handle)

    @property
    def values(self) -> ParameterArrays:
        """Values of the groups."""
        rows = np.empty_like(self._rows)
        self._library.csplat_refit_read(self._handle, _address(rows))
        return self._groups_of(rows)

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of drawn splats, and of pairs of splat and tile, in the last view."""
        return self._measurements()[1]

    def phase_seconds(self) -> F64:
        """Return the seconds of wall time in each of `PHASES` since the last call or use of `counts`."""
        return self._measurements()[0]

    def render(self, camera: Camera) -> F32:
        """Return the image of a view, [H, W, 3]."""
        image = np.empty((camera.H, camera.W, 3), np.float32)
        self._view(camera, image=image)
        return image

    def gradients(self, camera: Camera, reference: F32) -> tuple[float, F32, ParameterArrays]:
        """Return the squared error of a view, its image, and the gradients of half the error."""
        image, rows = np.empty((camera.H, camera.W, 3), np.float32), np.empty_like(self._rows)
        error = self._view(camera, reference, image=image, gradients=rows)
        return error, image, self._groups_of(rows)

    def step(self, camera: Camera, reference: F32, length: float) -> float:
        """Make a step of a length, and return the squared error of the view before."""
        rates = np.array([*(rates_of(length)[name] for name in GROUPS), _BETA2], np.float32)
        return self._view(camera, reference, rates=rates)

    def _view(
        self,
        camera: Camera,
        reference: F32 | None = None,
        *,
        image: F32 | None = None,
        gradients: F32 | None = None,
        rates: F32 | None = None,
    ) -> float:
        assert reference is None or reference.shape == (camera.H, camera.W, 3)
        view = view_vector(camera)
        error: float = self._library.csplat_refit_view(
            self._handle,
            _address(view, np.float64),
            camera.W,
            camera.H,
            *(_address(array) for array in (self._background, reference, image, gradients, rates)),
        )
        return error

    def _measurements(self) -> tuple[F64, tuple[int, int]]:
        seconds, counts = np.zeros(len(PHASES)), np.zeros(2, np.int64)
        self._library.csplat_refit_measurements(self._handle, _address(seconds, np.float64), _address(counts, np.int64))
        return seconds, (int(counts[0]), int(counts[1]))

    def _groups_of(self, rows: F32) -> ParameterArrays:
        """Split rows into groups, without the means."""
        sizes = [int(np.prod(shape[1:])) for shape in self._shapes.values()]
        parts = np.split(rows[:, 3:], np.cumsum(sizes)[:-1], axis=1)
        return {name: part.reshape(self._shapes[name]) for name, part in zip(GROUPS, parts, strict=True)}


def _load(path: Path) -> ctypes.CDLL:
    """Load the library, and declare its functions; refit.cpp describes their arguments."""
    library, array, number = ctypes.CDLL(os.fspath(path)), ctypes.c_void_p, ctypes.c_int
    for name, result, arguments in (
        ("new", ctypes.c_void_p, [number, number, array, array, number]),
        ("view", ctypes.c_double, [ctypes.c_void_p, array, number, number, *[array] * 5]),
        ("read", None, [ctypes.c_void_p, array]),
        ("measurements", None, [ctypes.c_void_p, array, array]),
        ("free", None, [ctypes.c_void_p]),
    ):
        function = getattr(library, f"csplat_refit_{name}")
        function.restype, function.argtypes = result, arguments
    return library


def _address(array: NDArray[Any] | None, dtype: Any = np.float32) -> int | None:
    if array is None:
        return None
    assert array.dtype == dtype
    assert array.flags.c_contiguous
    return array.ctypes.data


def _rows_of(values: ParameterArrays) -> F32:
    """Return the library's rows: means, then `GROUPS`."""
    count = len(values["means"])
    columns = [values[name].reshape(count, int(np.prod(values[name].shape[1:]))) for name in ("means", *GROUPS)]
    return np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32)


def _neighbour_order(means: F32) -> NDArray[np.int32]:
    """Return the splats in Morton order; centres that are not finite count as 0."""
    if not len(means):
        return np.zeros(0, np.int32)
    finite = np.where(np.isfinite(means), means, 0).astype(np.float64)
    low, high = finite.min(axis=0), finite.max(axis=0)
    places = ((finite - low) / np.maximum(high - low, 1e-30) * _MORTON_TOP).astype(np.int64)
    return np.argsort(morton_codes(places.T), kind="stable").astype(np.int32)
