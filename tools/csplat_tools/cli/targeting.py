"""What `csplat encode` is told of targets and of views, without importing a renderer where none is wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.cli.parsing import parse_decibels
from csplat_tools.files.console import Progress, format_bytes, note
from csplat_tools.files.convert import Encoder, Made
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.importance import read_importance, weights_of
from csplat_tools.optimise.target import Target, parse_max_error, parse_size_bytes

if TYPE_CHECKING:
    from csplat_tools.views import DataOptions, ViewSet

__all__ = ["DEFAULT_VIEWS", "Looking", "Targeting", "target_lines"]

#: Virtual views that teach, at most.
DEFAULT_VIEWS = 160

_SECONDS_WORTH_SAYING = 10.0


@dataclass(frozen=True)
class Looking:
    """From where a scene is looked at, as a command line says it.

    Attributes:
        cameras: a camera file. data: or a data set. Without them views are virtual.
        background: behind everything; `None`: what the scene says, or black.
        count: virtual views that teach, at most.
    """

    cameras: str | None
    data: DataOptions | None
    background: tuple[float, float, float] | None
    count: int

    @property
    def is_given(self) -> bool:
        """Whether views are named."""
        return self.cameras is not None or self.data is not None

    def views(self, model: SplatModel, *, quiet: bool) -> ViewSet:
        """Find them, and say what the user should know of them."""
        from csplat_tools.views import find_view_set

        found = find_view_set(model, cameras=self.cameras, data=self.data, background=self.background, count=self.count)
        for line in () if quiet else found.notes:
            note(line)
        return found


@dataclass(frozen=True)
class Targeting:
    """What a command line says; see `csplat_tools.optimise`.

    Attributes:
        size: as `5MB`. psnr: dB. max_loss: as `0.3dB`. keep: share of the splats that stay.
        max_error: as `means=0.001,opacities=0.01`.
        keep_all: every splat stays.
        importance: a file of weights.
        looking: from where.
    """

    size: str | None
    psnr: float | None
    max_loss: str | None
    keep: float | None
    max_error: str | None
    keep_all: bool
    importance: str | None
    looking: Looking

    @property
    def asked(self) -> bool:
        """Whether there is a target."""
        return self.is_rendered or self.max_error is not None

    @property
    def is_rendered(self) -> bool:
        """Whether it is one that pictures are rendered for."""
        return any(one is not None for one in (self.size, self.psnr, self.max_loss, self.keep))

    def encoder(self, *, quiet: bool) -> Encoder:
        """Return what makes a file of a scene.

        Raises:
            InputError: a renderer is wanted and not installed.
            typer.BadParameter: a target is none, or there are too many.
        """
        wanted = self._target()
        if self.is_rendered:
            prepare_renderer(quiet=quiet, simplify=True)

        def encode(model: SplatModel, encoding: EncodeOptions, progress: Progress | None) -> Made:
            target = wanted(model)
            found = None if self.importance is None else read_importance(self.importance, model)
            weights = None if found is None else weights_of(found, model)
            if not target.is_rendered:
                from csplat_tools.optimise.bounds import encode_within

                made = encode_within(model, target, encoding, importance=weights, progress=progress)
            else:
                from csplat_tools.optimise.optimiser import expected_seconds, optimise

                views = self.looking.views(model, quiet=quiet)
                seconds = expected_seconds(model, encoding, target, keep_all=self.keep_all)
                if not quiet and seconds > _SECONDS_WORTH_SAYING:
                    note(_forecast(seconds, may_keep_all=not self.keep_all and self.keep is None))
                made = optimise(
                    model, target, views, encoding, keep_all=self.keep_all, importance=weights, progress=progress
                )
            return Made(made.result, "target", made.report.as_json())

        return encode

    def _target(self) -> Callable[[SplatModel], Target]:
        """What is asked for, once it is known how long a unit of the scene is.

        Raises:
            typer.BadParameter: it is nothing that can be asked for.
        """
        try:
            size = None if self.size is None else parse_size_bytes(self.size)
            loss = None if self.max_loss is None else parse_decibels(self.max_loss)
            if self.is_rendered:
                Target(self.psnr, size, loss, self.keep)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None

        def of(model: SplatModel) -> Target:
            bounds = {} if self.max_error is None else parse_max_error(self.max_error, model.unit_metres)
            return Target(self.psnr, size, loss, self.keep, bounds)

        return of


def _forecast(seconds: float, *, may_keep_all: bool) -> str:
    """One line: how long it takes, and how to have it sooner."""
    about = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} minutes"
    sooner = "--keep-all takes a sixth of that, a preset seconds" if may_keep_all else "a preset takes seconds"
    return f"this takes about {about} on two cores; {sooner}"


def target_lines(said: Mapping[str, Any]) -> list[str]:
    """What a user should know of a search for a target, a sentence each.

    Args:
        said: the report of a search, see `csplat_tools.optimise.report.Progress`.
    """
    goal = said["goal"]
    asked = [f"{name} within {bound:g}" for name, bound in goal.get("max_error", {}).items()]
    if "size_bytes" in goal:
        share = 100.0 * said["size_bytes"] / goal["size_bytes"]
        asked.append(f"{format_bytes(goal['size_bytes'])}, of which the file takes {share:.1f} %")
    if "psnr" in goal:
        asked.append(f"{goal['psnr']:g} dB, of which it reaches {said['psnr']:.2f}")
    if "keep" in goal:
        asked.append(f"{100.0 * goal['keep']:g} % of {said['splats_before']} splats")
    if "max_loss" in goal:
        asked.append(f"a loss of {goal['max_loss']:g} dB by the photographs that decide")
    lines = [f"target: {'; '.join(asked)}"]
    if said["photographs"]:
        file, source = said["photographs"]["file"], said["photographs"]["source"]
        lines.append(f"photographs that judge: {file:.2f} dB, the source {source:.2f}")
    lines += [f"chosen: {line}" for line in said["why"]]
    if said["psnr"] is not None:
        lines.append(f"PSNR {said['psnr']:.2f} dB, {said['sure']}")
    cost = f"{said['encodes']} file{'s' if said['encodes'] > 1 else ''} tried"
    if said["renders"]:
        cost += f", {said['renders']} pictures judged"
    if said["sensitivity_views"]:
        cost += f", sensitivity measured in {said['sensitivity_views']}"
    if said["removal_views"]:
        cost += f", removal measured in {said['removal_views']} small ones"
    return [*lines, cost]
