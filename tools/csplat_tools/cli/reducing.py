"""What `csplat encode` is told of the simple strategies, without importing a renderer where none is wanted."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.cli.targeting import Looking
from csplat_tools.files.console import Progress
from csplat_tools.files.convert import Encoder, Made
from csplat_tools.files.extras import prepare_renderer

__all__ = ["Reducing"]


@dataclass(frozen=True)
class Reducing:
    """What a command line says; see `csplat_tools.study.Reduction` and `parse_kmeans`.

    Attributes:
        prune_opacity: splats of at most this alpha go.
        distil_sh: the degree given is reached by a fit to renders of the source.
        kmeans: `256`, `means=4096,quats=256`, `0.01`: entries or shares of the variance.
        residual_stages: codebooks per attribute; None: one.
        looking: views to distil by.
        sh_degree: of the file, as the encoder's options have it.
        seed: of the clustering.
        threads: how many.
    """

    prune_opacity: float | None
    distil_sh: bool
    kmeans: str | None
    residual_stages: int | None
    looking: Looking
    sh_degree: int | None
    seed: int
    threads: int | None

    @property
    def asked(self) -> bool:
        """Whether any strategy is named."""
        return self.distil_sh or self.prune_opacity is not None or self.kmeans is not None

    def encoder(self, *, quiet: bool) -> Encoder:
        """Return what makes a file of a scene.

        Raises:
            InputError: the renderer is wanted and not installed.
            typer.BadParameter: a value is out of range, or says nothing without another.
        """
        from csplat_tools.study import Reduction, encode_reduced, parse_kmeans

        if self.distil_sh and self.sh_degree is None:
            raise typer.BadParameter("--distil-sh wants --sh-degree: which degree is to be reached")
        try:
            stages = 1 if self.residual_stages is None else self.residual_stages
            kmeans = None if self.kmeans is None else parse_kmeans(self.kmeans, stages=stages, seed=self.seed)
            reduction = Reduction(
                self.prune_opacity, self.sh_degree, self.distil_sh, kmeans, self.looking.count, threads=self.threads
            )
        except InputError as error:
            raise typer.BadParameter(str(error)) from None
        if self.distil_sh:
            prepare_renderer(quiet=quiet, simplify=True)

        def encode(model: SplatModel, encoding: EncodeOptions, progress: Progress | None) -> Made:
            if not self.distil_sh:
                return Made(encode_reduced(model, reduction, encoding, progress=progress))
            if not self.looking.is_given:
                return Made(encode_reduced(model, reduction, encoding, progress=progress))
            views = self.looking.views(model, quiet=quiet)
            return Made(encode_reduced(model, reduction, encoding, views=views, progress=progress))

        return encode
