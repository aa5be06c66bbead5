"""What `csplat encode --simplify` asks for, without importing a renderer where none is wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.convert import Encoder, Made, Report
from csplat_tools.extras import prepare_renderer
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
        from csplat_tools.simplify.files import find_sights, parse_target

        try:
            loss = None if self.max_loss is None else parse_target(self.max_loss)
            size = None if self.target_size is None else parse_size_bytes(self.target_size)
            target = Target(self.keep, self.target_psnr, loss, size)
            options = SimplifyOptions(views=self.views, threads=self.threads)
        except InputError as error:
            raise typer.BadParameter(str(error)) from None

        def encode(model: SplatModel, encoding: EncodeOptions, progress: Report | None) -> Made:
            sights = find_sights(model, self.cameras, self.data, judged=target.max_loss is not None)
            file = encode_simplified(
                model, sights.cameras, target=target, encoding=encoding,
                options=replace(options, background=sights.background),
                photographs=sights.photographs, progress=progress,
            )  # fmt: skip
            return Made(file.result, "simplified", file.report)

        return encode
