"""What `csplat encode --simplify` asks for, without importing a renderer where none is wanted."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.convert import Encoder, Made, Report
from csplat_tools.extras import prepare_renderer
from csplat_tools.parsing import parse_decibels
from csplat_tools.rate.targets import parse_size_bytes

__all__ = ["DEFAULT_VIEWS", "Simplifying"]

#: Virtual views at most.
DEFAULT_VIEWS = 160


@dataclass(frozen=True)
class Simplifying:
    """What a command line says; see `csplat_tools.simplify.SimplifyOptions` and `Target`."""

    keep: float | None
    max_loss: str | None
    target_psnr: float | None
    target_size: str | None
    cameras: str | None
    data: str | None
    views: int
    threads: int | None

    def encoder(self, *, quiet: bool) -> Encoder:
        """Return what makes a file of a scene.

        Raises:
            InputError: the renderer is not installed.
            typer.BadParameter: the target is none, or several.
        """
        prepare_renderer(quiet=quiet, simplify=True)
        from csplat_tools.simplify import SimplifyOptions, Target, encode_simplified
        from csplat_tools.views import DataOptions, find_view_set

        try:
            loss = None if self.max_loss is None else parse_decibels(self.max_loss)
            size = None if self.target_size is None else parse_size_bytes(self.target_size)
            target = Target(self.keep, self.target_psnr, loss, size)
            options = SimplifyOptions(threads=self.threads)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None

        def encode(model: SplatModel, encoding: EncodeOptions, progress: Report | None) -> Made:
            data = None if self.data is None else DataOptions(self.data)
            views = find_view_set(model, cameras=self.cameras, data=data, count=self.views)
            file = encode_simplified(model, views, target=target, encoding=encoding, options=options, progress=progress)
            return Made(file.result, "simplified", file.report)

        return encode
