"""Quantisation-aware fine-tuning: what is rendered is what a decoder of the file will see."""

from __future__ import annotations

from csplat_trainer.tuning.finetuning import Clock, Finetuned, finetune
from csplat_trainer.tuning.loop import FinetuneResult, TuningStep, tune
from csplat_trainer.tuning.options import FinetuneOptions
from csplat_trainer.tuning.views import View, Views, renders_of, split_views

__all__ = [
    "Clock",
    "FinetuneOptions",
    "FinetuneResult",
    "Finetuned",
    "TuningStep",
    "View",
    "Views",
    "finetune",
    "renders_of",
    "split_views",
    "tune",
]
