"""`csplat sensitivity`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from csplat.errors import counted
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.shared_options import (
    Cameras,
    Data,
    Force,
    HelpAll,
    Json,
    Quiet,
    Report,
    SceneArgument,
    ViewOptions,
)
from csplat_tools.console import format_table
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.scene_files import load_model

#: Cost of the measurement, in renders of all views.
_PASSES = 4.4
_SHOWN = {"colour": "colour (largest of the SH coefficients)", "opacity": "opacity", "shape": "shape, over its size"}


def sensitivity(
    source: SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    cameras: Cameras = None,
    data: Data = None,
    force: Force = False,
    report: Report = None,
    as_json: Json = False,
    quiet: Quiet = False,
    _all: HelpAll = False,
) -> None:
    """Measure how much renders depend on each splat.

    `csplat encode --importance` reads the file, which is valid for this scene
    only. The images of the training give the best result; without them,
    virtual views are added until they agree. Requires the render extra.

    Examples:
      csplat sensitivity scene.ply scene.npz --data photographs
      csplat encode scene.ply scene.csplat --importance scene.npz
    """
    out = Output(force, report, as_json, quiet)
    views = ViewOptions(cameras, data)
    out.check(inputs=(source, *views.inputs), named={"OUT.npz": output})
    check_name(output, ".npz", "sensitivity", source)
    require_renderer()
    from csplat_tools.optimise.scene_sensitivity import measure_scene
    from csplat_tools.views.view_sets import total_render_seconds

    with out.bar() as progress:
        read = load_model(source)
        out.print_findings(read.findings)
        model = read.model
        are_virtual = data is None and cameras is None
        prepare_renderer(quiet=out.quiet, simplify=are_virtual)
        around = views.find(
            model, out, count=None if cameras is None else 0, validation_count=None if data is None else 0
        )
        out.announce_time(
            lambda: _PASSES * total_render_seconds(model, around.training or around.test),
            "--cameras with fewer or smaller views takes less",
        )
        measured = measure_scene(model, around, progress=progress)
    measured.write(output)
    scores = measured.as_json()
    out.remark(*_lines(scores))
    out.publish(scores)


def _lines(report: Mapping[str, Any]) -> list[str]:
    unseen = f"no view saw {report['unseen']} of them ({100.0 * report['unseen_share']:.2f} %)"
    lines = [
        f"{counted(report['splats'], 'splat')} from {counted(report['views'], report['source'] + ' view')}; {unseen}"
    ]
    if report["missed_share"] is not None:
        lines.append(f"held-out views saw {100.0 * report['missed_share']:.2f} % more of the splats")
    rows = [
        (label, *(f"{report['quantiles'][name][q]:.3g}" for q in ("0.5", "0.9", "0.99", "1.0")))
        for name, label in _SHOWN.items()
    ]
    return [*lines, format_table(("sensitivity", "median", "90 %", "99 %", "largest"), rows)]
