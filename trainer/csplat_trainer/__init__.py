# SPDX-License-Identifier: Apache-2.0
"""Training of Gaussian splats on a CPU or a GPU: data sets, losses, optimisation, and a torch wrapper of the renderer.

    >>> import csplat_trainer
    >>> trained = csplat_trainer.train("capture")  # doctest: +SKIP

The names load their modules on first use. `train` and `finetune` require gsplat on a GPU. The engines in torch,
`torch_rasteriser`, the perceptual loss, and `torch_checkpoints`, with which `csplat.read` reads checkpoints of gsplat
and splatfacto, require torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from csplat import lazy_exports

if TYPE_CHECKING:
    from csplat_trainer.data import DataSet, load
    from csplat_trainer.training_loop import train
    from csplat_trainer.training_options import Outputs, TrainOptions, TrainResult
    from csplat_trainer.tuning import FinetuneOptions, TunedFile, TuningViews, finetune

__all__ = [
    "DataSet",
    "FinetuneOptions",
    "Outputs",
    "TrainOptions",
    "TrainResult",
    "TunedFile",
    "TuningViews",
    "finetune",
    "load",
    "train",
]

_MODULE_OF = {
    "DataSet": "csplat_trainer.data",
    "FinetuneOptions": "csplat_trainer.tuning",
    "Outputs": "csplat_trainer.training_options",
    "TrainOptions": "csplat_trainer.training_options",
    "TrainResult": "csplat_trainer.training_options",
    "TunedFile": "csplat_trainer.tuning",
    "TuningViews": "csplat_trainer.tuning",
    "finetune": "csplat_trainer.tuning",
    "load": "csplat_trainer.data",
    "train": "csplat_trainer.training_loop",
}
__getattr__, __dir__ = lazy_exports(__name__, _MODULE_OF)
