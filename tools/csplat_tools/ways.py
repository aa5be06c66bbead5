"""Which of its ways `csplat encode` goes: plainly, to a target, simplified, or by simple strategies."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from csplat.encoder import EncodeOptions
from csplat_tools.convert import Encoder
from csplat_tools.reducing import Reducing
from csplat_tools.simplifying import Simplifying
from csplat_tools.targeting import Targeting

__all__ = ["Ways"]


@dataclass(frozen=True)
class Ways:
    """What a command line says of all of them.

    Attributes:
        encoding: options of the encoder.
        simplify: whether to simplify. simplifying: how.
        targeting: the targets.
        reducing: the simple strategies.
        prune_unseen: whether what `importance` did not see goes.
        views_given: whether a number of virtual views was given.
    """

    encoding: EncodeOptions
    simplify: bool
    simplifying: Simplifying
    targeting: Targeting
    reducing: Reducing
    prune_unseen: bool
    views_given: bool

    def encoder(self, *, quiet: bool) -> Encoder | None:
        """Return what makes a file of a scene; None for the plain encoder.

        Raises:
            InputError: the renderer is wanted and not installed.
            typer.BadParameter: options contradict each other, or say nothing.
        """
        self._check()
        if self.simplify:
            return self.simplifying.encoder(quiet=quiet)
        if self.targeting.asked:
            return self.targeting.encoder(quiet=quiet)
        return self.reducing.encoder(quiet=quiet) if self.reducing.asked else None

    def _check(self) -> None:
        simplifying, target, reducing = self.simplifying, self.targeting, self.reducing
        importance = target.importance is not None
        looks = target.cameras is not None or target.data is not None
        looks_for = target.size is not None or target.psnr is not None
        chooses = looks_for or (self.simplify and simplifying.max_loss is not None)
        renders = self.simplify or looks_for or reducing.distil_sh
        several = self.encoding.grades is not None and self.encoding.grades > 1
        both = (self.simplify or target.asked) and reducing.asked
        refused = (
            (self.simplify and target.max_error is not None,
             "--max-error goes with no --simplify: what is fitted has no bounds"),
            (not self.simplify and (simplifying.keep is not None or simplifying.max_loss is not None),
             "--keep and --max-loss say nothing without --simplify"),
            (both, "--prune-opacity, --distil-sh and --kmeans go with neither a target nor --simplify: those choose"),
            (looks and not (self.simplify or target.asked or reducing.asked),
             "--cameras and --data say nothing without a target, --simplify or --distil-sh"),
            (target.prune is not None and (self.simplify or not target.asked),
             "--prune and --keep-all say nothing without a target, or with --simplify"),
            (self.simplify and importance, "--simplify measures the importance of splats itself"),
            (reducing.asked and importance, "--prune-opacity, --distil-sh and --kmeans do not look at --importance"),
            (self.prune_unseen and not importance, "--prune-unseen wants --importance, which says what was seen"),
            (self.prune_unseen and target.asked,
             "--prune-unseen and a target: a target chooses itself what is left out"),
            (chooses and self.encoding.attribute_psnr is not None,
             "--attribute-psnr is what a target chooses: give one of them"),
            (self.views_given and not renders,
             "--views says nothing without a target size or PSNR, --simplify or --distil-sh"),
            (several and self.encoding.shape_codebook_size,
             "--grades and --shape-codebook-size: entries of a codebook have one precision"),
            (several and not (self.simplify or looks_for or importance),
             "--grades says nothing without a target size or PSNR, --simplify or --importance: views sort the splats"),
            (reducing.residual_stages is not None and reducing.kmeans is None,
             "--residual-stages says nothing without --kmeans"),
        )  # fmt: skip
        for wrong, why in refused:
            if wrong:
                raise typer.BadParameter(why)
