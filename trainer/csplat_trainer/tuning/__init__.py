# SPDX-License-Identifier: Apache-2.0
"""Quantisation-aware fine-tuning: renders during the tuning show the decoded file."""

from __future__ import annotations

from csplat_trainer.tuning.tuned_encoding import StageTimer, TunedFile, finetune
from csplat_trainer.tuning.tuning_loop import TuningResult, tune
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningView, TuningViews, renders_of, split_views

__all__ = [
    "FinetuneOptions",
    "StageTimer",
    "TunedFile",
    "TuningResult",
    "TuningView",
    "TuningViews",
    "finetune",
    "renders_of",
    "split_views",
    "tune",
]
