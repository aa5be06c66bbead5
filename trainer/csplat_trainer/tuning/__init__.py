"""Quantisation-aware fine-tuning: what is rendered is what a decoder of the file will see."""

from __future__ import annotations

from csplat_trainer.tuning.tuned_encoding import Clock, Finetuned, finetune
from csplat_trainer.tuning.tuning_loop import FinetuneResult, TuningStep, tune
from csplat_trainer.tuning.tuning_options import FinetuneOptions, TuningView, TuningViews, renders_of, split_views

__all__ = [
    "Clock",
    "FinetuneOptions",
    "FinetuneResult",
    "Finetuned",
    "TuningStep",
    "TuningView",
    "TuningViews",
    "finetune",
    "renders_of",
    "split_views",
    "tune",
]
