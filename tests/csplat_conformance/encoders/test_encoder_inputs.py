"""Tests of csplat_conformance.encoders.encoder_inputs."""

import numpy as np
import pytest
from tables import failures

from csplat_conformance.encoders import all_inputs

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}


def test_inputs_have_unique_names_a_reason_and_a_duty():
    assert len(all_inputs()) == len(INPUTS)
    for name, one in INPUTS.items():
        assert one.why
        assert {"ordinary": (0, 0), "nasty": (1, 0), "broken": (0, 1)}[name.split("/")[0]] == (
            one.may_refuse, one.must_refuse
        )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "left_out"),
    [("nasty/not_a_number", 3), ("nasty/infinities", 4), ("nasty/infinite_scales", 1), ("nasty/beyond_float", 2)],
)
def test_invalid_rows_are_not_in_the_source(name, left_out):
    # SRC-1
    assert 64 - left_out == len(ENCODABLE[name].source())
    assert {64} == {len(ENCODABLE[name].source()) for name in ("nasty/nan_normals", "nasty/nan_extra")}


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
