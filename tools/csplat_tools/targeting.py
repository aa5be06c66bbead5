"""What `csplat encode` is told of targets, without importing a renderer where none is wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.console import format_bytes
from csplat_tools.convert import Encoder, Made, Report
from csplat_tools.extras import prepare_renderer
from csplat_tools.importances import read_importance, weights_of
from csplat_tools.rate.bounds import meet_bounds
from csplat_tools.rate.targets import RateTarget, parse_max_error, parse_size_bytes

__all__ = ["Targeting", "target_lines"]


@dataclass(frozen=True)
class Targeting:
    """What a command line says; see `csplat_tools.rate`.

    Attributes:
        size: as `5MB`. psnr: dB. max_error: as `means=0.001,opacities=0.01`.
        prune: whether splats may be left out; None: where views show what matters.
        importance: a file of weights.
        cameras, data: views to judge by, a camera file or a data set.
        views: virtual views at most that decide what is left out.
        threads: how many.
    """

    size: str | None
    psnr: float | None
    max_error: str | None
    prune: bool | None
    importance: str | None
    cameras: str | None
    data: str | None
    views: int
    threads: int | None

    @property
    def asked(self) -> bool:
        """Whether there is a target."""
        return self.size is not None or self.psnr is not None or self.max_error is not None

    def encoder(self, *, quiet: bool) -> Encoder:
        """Return what makes a file of a scene.

        Raises:
            InputError: a renderer is wanted and not installed.
            typer.BadParameter: a target is none, or there are too many.
        """
        rendered = self.size is not None or self.psnr is not None
        try:
            size = None if self.size is None else parse_size_bytes(self.size)
            if rendered:
                RateTarget(size, self.psnr)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None
        if not rendered and (self.cameras is not None or self.data is not None):
            raise typer.BadParameter("--cameras and --data say nothing with --max-error alone: nothing is rendered")
        if rendered:
            prepare_renderer(quiet=quiet, simplify=self.prune is not False)

        def encode(model: SplatModel, encoding: EncodeOptions, progress: Report | None) -> Made:
            bounds = {} if self.max_error is None else parse_max_error(self.max_error, model.unit_metres)
            found = None if self.importance is None else read_importance(self.importance, model)
            weights = None if found is None else weights_of(found, model)
            if not rendered:
                bounded = meet_bounds(model, encoding, bounds, importance=weights, progress=progress).as_result()
                return Made(bounded.result, "target", bounded.report)
            from csplat_tools.rate.control import encode_to_target
            from csplat_tools.views import DataOptions, find_view_set

            data = None if self.data is None else DataOptions(self.data)
            around = find_view_set(model, cameras=self.cameras, data=data, aside=0, count=0)
            given = None if self.cameras is None and data is None else around.teaches or around.judges
            done = encode_to_target(
                model, RateTarget(size, self.psnr, bounds), encoding, cameras=given,
                background=around.background, prune=self.prune, views=self.views,
                importance=weights, progress=progress,
            )  # fmt: skip
            return Made(done.result, "target", done.report)

        return encode


def target_lines(said: Mapping[str, Any]) -> list[str]:
    """What a user should know of a search for a target, a sentence each.

    Args:
        said: the report of `encode_to_target`.
    """
    goal = said["goal"]
    asked = [f"{name} within {bound:g}" for name, bound in goal.get("max_error", {}).items()]
    if "size_bytes" in goal:
        share = 100.0 * said["size_bytes"] / goal["size_bytes"]
        asked.append(f"{format_bytes(goal['size_bytes'])}, of which the file takes {share:.1f} %")
    if "psnr" in goal:
        asked.append(f"{goal['psnr']:g} dB, of which it reaches {said['psnr']:.2f}")
    lines = [f"target: {'; '.join(asked)}"]
    lines += [f"chosen: {line}" for line in said.get("why", [])]
    if "sure" in said:
        lines.append(f"PSNR {said['psnr']:.2f} dB, {said['sure']}")
    cost = f"{said['encodes']} files tried"
    if said["renders"]:
        cost += f", {said['renders']} pictures rendered"
    if said.get("sensitivity_views"):
        cost += f", sensitivity measured in {said['sensitivity_views']}"
    if said.get("removal_views"):
        cost += f", removal measured in {said['removal_views']} small ones"
    return [*lines, cost]
