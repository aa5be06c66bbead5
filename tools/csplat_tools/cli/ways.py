"""Which of its ways `csplat encode` goes: plainly, to a target, or by simple strategies."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from csplat.encoder import EncodeOptions
from csplat_tools.cli.reducing import Reducing
from csplat_tools.cli.targeting import Targeting
from csplat_tools.files.convert import Encoder

__all__ = ["Ways"]


@dataclass(frozen=True)
class Ways:
    """What a command line says of all of them.

    Attributes:
        encoding: options of the encoder.
        targeting: the targets.
        reducing: the simple strategies.
        prune_unseen: whether what `importance` did not see goes.
        views_given: whether a number of virtual views was given.
    """

    encoding: EncodeOptions
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
        if self.targeting.asked:
            return self.targeting.encoder(quiet=quiet)
        return self.reducing.encoder(quiet=quiet) if self.reducing.asked else None

    def _check(self) -> None:
        target, reducing, encoding = self.targeting, self.reducing, self.encoding
        importance, looking = target.importance is not None, target.looking
        renders = target.is_rendered or reducing.distil_sh
        searches = target.is_rendered and target.keep is None
        several = encoding.grades is not None and encoding.grades > 1
        refused = (
            (target.asked and reducing.asked,
             "--prune-opacity, --distil-sh and --kmeans go with no target: that chooses itself"),
            (looking.is_given and target.max_error is not None and not target.is_rendered,
             "--cameras and --data say nothing with --max-error alone: nothing is rendered"),
            (looking.is_given and not renders,
             "--cameras and --data say nothing without a target or --distil-sh"),
            (looking.background is not None and not (renders and looking.is_given),
             "--background says nothing without --data or --cameras: virtual views are on black"),
            (target.max_loss is not None and looking.data is None,
             "--max-loss wants --data: photographs say what is lost"),
            (target.keep_all and not (searches or target.max_error is not None),
             "--keep-all says nothing without a target that could leave splats out"),
            (target.keep is not None and importance, "--keep measures the importance of splats itself"),
            (reducing.asked and importance, "--prune-opacity, --distil-sh and --kmeans do not look at --importance"),
            (self.prune_unseen and not importance, "--prune-unseen wants --importance, which says what was seen"),
            (self.prune_unseen and target.asked,
             "--prune-unseen and a target: a target chooses itself what is left out"),
            (searches and encoding.attribute_psnr is not None,
             "--attribute-psnr is what a target chooses: give one of them"),
            (self.views_given and not renders, "--views says nothing without a target or --distil-sh"),
            (several and encoding.shape_codebook_size,
             "--grades and --shape-codebook-size: entries of a codebook have one precision"),
            (several and not (target.is_rendered or importance),
             "--grades says nothing without a target or --importance: views sort the splats"),
            (reducing.residual_stages is not None and reducing.kmeans is None,
             "--residual-stages says nothing without --kmeans"),
        )  # fmt: skip
        for wrong, why in refused:
            if wrong:
                raise typer.BadParameter(why)
