# SPDX-License-Identifier: Apache-2.0
"""`csplat sensitivity`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat.context import Context
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.file_streams import check_name
from csplat_tools.inspect.text_reports import format_sensitivity
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import load_scene

#: Cost of the measurement, in renders of all views.
_PASSES = 4.4


def sensitivity(
    source: shared.SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    cameras: shared.Cameras = None,
    data: shared.Data = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Measure how much renders depend on each splat.

    `csplat encode --importance` reads the file, which is valid for this scene
    only. The images of the training give the best result; without them,
    virtual views are added until they agree. --data requires the render
    extra.

    Examples:
      csplat sensitivity scene.ply scene.npz --data capture
      csplat encode scene.ply scene.csplat --importance scene.npz
    """
    out = Output(force, report, as_json, quiet)
    views = shared.ViewOptions(cameras, data)
    out.check(inputs=(source, *views.inputs), named={"OUT.npz": output})
    check_name(output, ".npz", "sensitivity", source)
    require_renderer()
    from csplat_tools.scene_sensitivity import measure_scene
    from csplat_tools.views.view_sets import total_render_seconds

    with out.bar() as progress:
        read = load_scene(source)
        out.print_findings(read.findings)
        model = read.model()
        view_set = views.find(
            model, out, source, count=None if cameras is None else 0, validation_count=None if data is None else 0
        )
        out.announce_time(
            lambda: _PASSES * total_render_seconds(model, view_set.training or view_set.test),
            "--cameras with fewer or smaller views takes less",
        )
        measured = measure_scene(model, view_set, context=Context(progress=progress))
    measured.write(output)
    scores = measured.as_json()
    out.remark(*format_sensitivity(scores))
    out.publish(scores)
