"""`csplat sensitivity`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from csplat.errors import counted
from csplat_tools.cli.command import OutputOptions, command
from csplat_tools.cli.shared_options import SceneArgument, Seed, Threads, ViewOptions, VirtualViewOptions
from csplat_tools.console import format_table
from csplat_tools.file_streams import check_name
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.scene_files import load_model

#: Cost of the measurement, in renders of all views.
_PASSES = 4.4
_SHOWN = {"colour": "colour (largest of the SH coefficients)", "opacity": "opacity", "shape": "shape, over its size"}


@command(reads=True)
def sensitivity(
    source: SceneArgument,
    output: Annotated[str, typer.Argument(metavar="OUT.npz", help="The file to write.")],
    views: ViewOptions,
    virtual: VirtualViewOptions,
    out: OutputOptions,
    matrices: Annotated[
        bool,
        typer.Option(
            "--matrices/--no-matrices",
            help="Store the Gauss–Newton blocks of SH, 240 bytes per splat.",
        ),
    ] = True,
    seed: Seed = 0,
    threads: Threads = None,
) -> None:
    """Measure how much renders depend on each splat, attribute by attribute.

    `csplat encode --importance` takes the file, and spends bytes where they
    show. It is valid for this scene only. Training photographs give the best
    result; without them virtual views are added until they agree. Requires the
    packages of the render extra.

    Examples:
      csplat sensitivity scene.ply scene.npz --data photographs
      csplat encode scene.ply scene.csplat --importance scene.npz
    """
    out.check(inputs=(source, *views.inputs), named={"OUT.npz": output})
    check_name(output, ".npz", "sensitivity", source)
    require_renderer()
    from csplat_tools.optimise.scene_sensitivity import measure_scene
    from csplat_tools.views.view_sets import total_render_seconds

    read = load_model(source)
    out.print_findings(read.findings)
    model = read.model
    looked_for = views.data is None and views.cameras is None  # virtual ones
    prepare_renderer(quiet=out.quiet, simplify=looked_for)
    count = {"count": 0} if views.cameras is not None else {}
    around = views.find(
        model, out, seed=seed, validation_count=None if views.data is None else 0, **virtual.given() | count
    )
    out.announce_time(
        lambda: _PASSES * total_render_seconds(model, around.training or around.test),
        "fewer or smaller views take less: --help-all",
    )
    with out.bar() as progress:
        measured = measure_scene(model, around, matrices=matrices, threads=threads, progress=progress)
    measured.write(output)
    report = measured.as_json()
    out.remark(*_lines(report))
    out.publish(report)


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
