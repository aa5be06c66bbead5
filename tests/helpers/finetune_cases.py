"""Helpers of the tests of finetune, which several files share."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from captures import cameras

from csplat import EncodeOptions
from csplat_render import render
from csplat_render.conventions import UncheckedSplats
from csplat_tools.training import tuning_run
from csplat_tools.views import ViewSet
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions

pytest.importorskip("numba", reason="requires the extra [render]")

BLACK = np.zeros(3, np.float32)
QUICK = FinetuneOptions(iterations=30, warm_up=5, validate_every=10, log_every=5)
FEW = FinetuneOptions(iterations=12, warm_up=2, validate_every=4, log_every=2)
COARSE = EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16)


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
