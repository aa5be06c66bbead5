# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of train, which several files share."""

from __future__ import annotations

import numpy as np
import pytest

from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs

SIZE = 32
QUICK = {"max_splats": 80, "sh_degree": 1, "iterations": 60, "refine_start": 20, "refine_every": 10, "log_every": 20}


def assert_resumes_identically(data, options, folder):
    """Compare a run with one that is killed and resumed; return the run and the checkpoint of step 25."""
    stopped = folder / "stopped.npz"

    def kill(now):
        if now.iteration == 40:
            raise KeyboardInterrupt

    whole = train(data, options)
    with pytest.raises(KeyboardInterrupt):
        train(data, options, on_step=kill, outputs=Outputs(checkpoint=stopped, checkpoint_every=25))
    again = train(data, options, outputs=Outputs(resume=stopped))
    for name in ("means", "shN"):
        assert np.array_equal(getattr(whole.model, name), getattr(again.model, name))
    assert whole.log["losses"] == again.log["losses"]
    assert whole.log.get("exposures") == again.log.get("exposures")
    return whole, stopped
