# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.encoders.encoder_inputs."""

import numpy as np
import pytest
from encoder_runs_cases import ENCODABLE, INPUTS
from tables import failures

from csplat_conformance.encoders import all_inputs


def test_inputs_have_unique_names_a_reason_and_a_duty():
    duties = {"ordinary": (False, False), "nasty": (True, False), "broken": (False, True)}
    assert len(all_inputs()) == len(INPUTS)
    for name, one in INPUTS.items():
        assert one.why
        assert duties[name.split("/")[0]] == (one.may_refuse, one.must_refuse)


def test_invalid_rows_are_not_in_the_source():
    # SRC-1
    left_out = {"not_a_number": 3, "infinities": 4, "infinite_scales": 1, "beyond_float": 2}
    left_out |= {"nan_normals": 0, "nan_extra": 0}
    assert left_out == {name: 64 - len(ENCODABLE[f"nasty/{name}"].source()) for name in left_out}


@pytest.mark.long
def test_different_splats_keep_their_distance():
    def check(one):
        means = np.unique(one.source().means.astype(np.float64), axis=0)  # sorted by x
        least = one.separation * (1 - 1e-5)  # the lattice of float32
        for step in range(1, len(means)):
            away = means[step:] - means[:-step]
            if away[:, 0].min() >= least:
                break
            assert np.linalg.norm(away, axis=1).min() >= least

    assert [] == failures([one for name, one in ENCODABLE.items() if name != "ordinary/two_tiles"], check)


def test_another_quality_moves_the_required_psnr_of_all_pictures():
    def required(name, quality):
        return INPUTS[f"ordinary/{name}"].psnr_required(quality)

    assert [30.0, 28.0, 32.0] == [required(name, 30.0) for name in ("degree_3", "needles_and_discs", "surfaces")]
    assert [25.0, 27.0] == [required(name, 25.0) for name in ("degree_3", "glossy")]
