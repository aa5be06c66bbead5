# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of train, which several files share."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest

from csplat_trainer.fit_checkpoint import load_checkpoint
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs

SIZE = 32
QUICK = {"max_splats": 80, "sh_degree": 1, "iterations": 60, "refine_start": 20, "refine_every": 10, "log_every": 20}


def assert_resumes_identically(data, options, folder):
    """Compare a run with one that Ctrl-C ends after step 35 and that is resumed; return the run and the checkpoint."""
    stopped = folder / "stopped.npz"

    def interrupt(now):
        if now.iteration == 35:
            signal.raise_signal(signal.SIGINT)

    whole, often = train(data, options), replace(options, log_every=7)
    with pytest.raises(KeyboardInterrupt):
        train(data, often, on_step=interrupt, outputs=Outputs(checkpoint=stopped, checkpoint_seconds=1e9))
    assert 35 == load_checkpoint(stopped).iteration
    again = train(data, options, outputs=Outputs(resume=stopped))
    for name in ("means", "shN"):
        assert np.array_equal(getattr(whole.model, name), getattr(again.model, name))
    assert whole.log["losses"] == again.log["losses"]
    assert whole.log.get("exposures") == again.log.get("exposures")
    return whole, stopped
