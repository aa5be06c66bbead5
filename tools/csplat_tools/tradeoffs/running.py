"""Run the sweep point by point; a point that fails does not stop the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from csplat.errors import CsplatError, InputError, counted
from csplat.inputs import File
from csplat.model import SplatModel
from csplat.types import Progress, null_progress
from csplat_render.kernels import thread_count
from csplat_render.metrics import Scores
from csplat_tools.files.console import format_about, format_bytes
from csplat_tools.files.extras import need_renderer
from csplat_tools.tradeoffs.machine import describe_machine
from csplat_tools.tradeoffs.measuring import DECODE_RUNS, Measurer
from csplat_tools.tradeoffs.options import Wanted
from csplat_tools.tradeoffs.points import Failure, ModeTime, Point, pareto_front
from csplat_tools.tradeoffs.setting import Setting, read_setting
from csplat_tools.tradeoffs.sweep import Candidate, candidates
from csplat_tools.views import Colour, DataOptions

# Seconds by kind of point, on two cores: a fixed part (scores, and for presets those with fewer bands); per million
# splats; and per second that eight renders of the source take. Only for the estimate that is shown to the user.
_COSTS = {
    "presets": (3.6, 12.0, 10.0),
    "precision": (1.2, 12.0, 4.0),
    "strategies": (1.2, 12.0, 4.0),
    "k-means": (1.2, 250.0, 6.0),
    "distilled": (1.2, 40.0, 80.0),
    "targets": (1.2, 0.0, 362.5),  # 2,900 renders, see `optimiser`
    "simplify": (1.2, 40.0, 250.0),
    "finetune": (1.2, 100.0, 500.0),
}


@dataclass(frozen=True, eq=False)
class Tradeoff:
    """The results of a sweep.

    Attributes:
        setting: the scene and its views.
        wanted: the options of the sweep.
        points: all points, measured or failed, in the order of the sweep.
        source_modes: times of rendering the source, by mode of the renderer.
        source_photographs: the source's scores against photographs, if there are any.
        machine: processor, system, versions.
    """

    setting: Setting
    wanted: Wanted
    points: Sequence[Point | Failure]
    source_modes: dict[str, ModeTime]
    source_photographs: Scores | None
    machine: dict[str, Any]

    @property
    def measured(self) -> list[Point]:
        """The points that were measured, the smallest file first."""
        return sorted((one for one in self.points if isinstance(one, Point)), key=lambda one: one.size_bytes)

    @property
    def failures(self) -> list[Failure]:
        """The points that could not be measured."""
        return [one for one in self.points if isinstance(one, Failure)]

    @property
    def front(self) -> list[Point]:
        """The points that no other one beats in size and `psnr`, the smallest file first."""
        measured = self.measured
        return [measured[place] for place in pareto_front([(one.size_bytes, one.psnr) for one in measured])]

    @property
    def photograph_front(self) -> list[Point]:
        """The points that no other one beats in size and PSNR against photographs; empty without photographs."""
        known = [one for one in self.measured if one.photograph_psnr is not None]
        return [known[at] for at in pareto_front([(one.size_bytes, one.photograph_psnr or 0.0) for one in known])]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        setting = self.setting
        return {
            "scene": {
                "name": setting.name,
                "size_bytes": setting.source_bytes,
                "splats": len(setting.source),
                "sh_degree": setting.source.sh_degree,
                "defects": [str(one) for one in setting.findings],
            },
            "views": {
                "cameras": setting.views.name,
                "count": len(setting.views.judges),
                "sizes": sorted({(camera.W, camera.H) for camera in setting.views.judges}),
                "background": list(setting.views.judging_background),
            },
            "machine": self.machine,
            "times": f"single runs; decoding: the median of {DECODE_RUNS}; rendering: the median over views",
            "source": {
                "render": {name: one.as_json() for name, one in self.source_modes.items()},
                "photographs": None if self.source_photographs is None else self.source_photographs.as_json(),
            },
            "pareto": [one.name for one in self.front],
            "pareto_photographs": [one.name for one in self.photograph_front],
            "points": [one.as_json() for one in self.points],
        }


def tradeoff(
    scene: SplatModel | File | Setting,
    wanted: Wanted | None = None,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    lpips: str | None = None,
    say: Callable[[str], None] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Tradeoff:
    """Make and measure all files of a sweep, as `csplat tradeoff` does. Takes minutes, and requires the render extra.

    Args:
        scene: a model, or a file; or the `Setting` of an earlier sweep, instead of this and all other inputs.
        wanted: the points to measure; `None`: presets, precision, strategies, targets and simplification.
        cameras, data, background: views by which files are chosen and scored, as for `find_view_set`; given by name,
            so that the report can contain the command for each file.
        lpips: a file of LPIPS weights, or `auto`; LPIPS is not computed if left out.
        say: called with a line on the expected time, and with one for each file when it is measured.
        progress: called with the stage and the fraction of it that is done, 0 to 1.

    Returns:
        All points, measured or failed; those on the Pareto front; and everything as JSON (`as_json`).

    Examples:
        >>> import csplat_tools
        >>> found = csplat_tools.tradeoff("scene.ply", csplat_tools.Wanted(what=("presets",)))  # doctest: +SKIP
        >>> [(point.name, point.size_bytes, point.psnr) for point in found.front]  # doctest: +SKIP

    Raises:
        InputError: there is nothing to sweep, or not one point could be measured.
        CsplatError: a file is not valid.
        OSError: a file cannot be read.
    """
    need_renderer()
    if isinstance(scene, Setting):
        setting = scene
    else:
        setting = read_setting(scene, cameras=cameras, data=data, background=background, lpips=lpips)
    wanted = wanted or Wanted()
    report: Progress = progress or null_progress
    tell = say or (lambda _line: None)
    with thread_count(wanted.threads):
        measurer = Measurer(setting, wanted.modes, wanted.threads)
        tried = candidates(setting, wanted)
        if not tried:
            raise InputError("nothing to sweep: what is asked for has no values")
        costs = [estimated_seconds(one.cost or one.family, setting, wanted, measurer.source_modes) for one in tried]
        tell(f"{counted(len(tried), 'file')} to make and to measure: about {format_about(sum(costs))} here")
        points = list[Point | Failure]()
        for number, candidate in enumerate(tried):
            report("the sweep", sum(costs[:number]) / sum(costs))
            points.append(_measured(measurer, candidate, lambda _stage, done: report("this file", done)))
            tell(_line(points[-1], number + 1, len(tried)))
    first = points[0]
    if isinstance(first, Failure) and all(isinstance(one, Failure) for one in points):
        raise InputError(f"no point could be measured; {first.name}: {first.error}")
    machine = describe_machine(wanted.threads)
    return Tradeoff(setting, wanted, points, measurer.source_modes, measurer.source_photographs, machine)


def estimated_seconds(kind: str, setting: Setting, wanted: Wanted, modes: dict[str, ModeTime]) -> float:
    """Estimate the seconds that a point of a kind takes, by the number of splats and the time of a render."""
    each, by_splats, by_pictures = _COSTS[kind]
    milliseconds = next((one.milliseconds for name, one in modes.items() if name != "exact"), 100.0)
    steps = wanted.iterations / Wanted.iterations if kind == "finetune" else 1.0
    return each + by_splats * len(setting.source) / 1e6 + by_pictures * steps * 8.0 * milliseconds / 1000.0


def _measured(measurer: Measurer, candidate: Candidate, progress: Progress) -> Point | Failure:
    try:
        return measurer.measure(candidate, progress)
    except CsplatError as error:
        return Failure(candidate.name, candidate.family, " ".join(str(error).split()))
    except MemoryError:
        return Failure(candidate.name, candidate.family, "out of memory")


def _line(point: Point | Failure, number: int, count: int) -> str:
    """Return a line on a point that has just been measured."""
    if isinstance(point, Failure):
        return f"{number}/{count} {point.name}: {point.error}"
    size, seconds = format_bytes(point.size_bytes), f"{point.encode_seconds:.1f} s"
    return f"{number}/{count} {point.name}: {size}, {point.psnr:.2f} dB, {seconds}"
