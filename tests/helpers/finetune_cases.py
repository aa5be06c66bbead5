# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of finetune, which several files share."""

import functools
import math
from types import SimpleNamespace

import numpy as np
from captures import cameras, shell

from csplat import EncodeOptions
from csplat.encoder import EncodePlan, fix_quantisation
from csplat_render import render
from csplat_render.conventions import UncheckedSplats
from csplat_tools.training import tuning_run
from csplat_tools.views import ViewSet
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views

BLACK = np.zeros(3, np.float32)
QUICK = FinetuneOptions(iterations=30, warm_up=5, validate_every=10, log_every=5)
FEW = FinetuneOptions(iterations=12, warm_up=2, validate_every=4, log_every=2)
COARSE = EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16)
SOURCE = shell(8)
COMMAND_OPTIONS = "csplat_tools.cli.finetune.EncodeOptions"
BARE = {"sh_coding": "none", "shape_codebook_size": 0}  # encode neither SH nor codebooks, which take time


def fixed_by(options, source=SOURCE):
    return fix_quantisation(EncodePlan.of(source, options))


@functools.cache
def coarse():
    """Return the fixed quantisation of a coarse file with a codebook."""
    return fixed_by(COARSE)


@functools.cache
def views_of_source():
    return split_views(renders_of(SOURCE, cameras(14), BLACK), BLACK, validation_count=3)


def psnr(model, views):
    error = [np.square(render(model, view.camera).rgb - view.reference).mean() for view in views]
    return -10.0 * math.log10(float(np.mean(error)))


def unchecked(seen):
    return UncheckedSplats(seen.means, seen.quats, seen.scales, seen.opacities, seen.sh0, seen.shN)


BRIEF = ("--preset", "fast", "--iterations", 1)  # for tests that do not depend on learning


def tuned_subset(size, **log):
    return tuning_run.TunedSubset(SimpleNamespace(data=bytes(round(size)), log=log), {}, {})


def tuner_of(kind, source, **options):
    training = cameras(14)
    views = ViewSet("virtual", (0.0, 0.0, 0.0), training[:10], training[10:], (), virtual=True)
    return kind(source, views, EncodeOptions(), FEW, Outputs(), prune_unseen=False, effort=1, **options)
