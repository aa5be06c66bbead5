"""Choose how many splats, and which precision, the tuning of a file of a given size starts from, by known drafts."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba", reason="tuning wants the extra [render]")
pytest.importorskip("scipy", reason="tuning wants the extra [render]")

from csplat.encoder import PRESETS, EncodeOptions
from csplat_tools.training import tuning_run
from csplat_tools.training.tuning_inputs import TuningSubset

USUAL = PRESETS["small"].quality[0]
ENTRIES = 1024


def bytes_of(count, options, per_db):
    """Return a size: 1,000 bytes, 10 per splat at the usual precision, and the bytes of entries beyond the usual."""
    finer = 0.0 if options.attribute_psnr is None else options.attribute_psnr - USUAL
    return round(1000 + 10 * count * np.exp(per_db * finer)) + 2 * max(0, (options.codebook_size or ENTRIES) - ENTRIES)


@pytest.fixture
def fit(make_model, monkeypatch):
    """Fit 9,000 splats to a size: how many are left, the options, the bytes of their draft, and how many there were."""

    def run(size_bytes, *, per_db=0.045, options=None):
        drafts = []

        def draft(model, encoding, **_):
            data = bytes(bytes_of(len(model), encoding, per_db))
            drafts.append(len(data))
            settings = {"codebook_size": ENTRIES, "sh_degree": model.sh_degree}
            made = SimpleNamespace(data=data, report=SimpleNamespace(options=settings))
            return SimpleNamespace(write=lambda: made)

        monkeypatch.setattr(tuning_run, "EncodePlan", SimpleNamespace(of=draft))
        monkeypatch.setattr(tuning_run, "encode_tiles", lambda plan, **_: plan)
        whole = make_model(9000, 1)

        def choose(count):
            return TuningSubset(whole.select(np.arange(count)), np.arange(count), None, {})

        chosen, encoding = tuning_run._fit_to_size(
            choose(9000), options or EncodeOptions("small"), size_bytes, choose, None
        )
        return len(chosen.model), encoding, bytes_of(len(chosen.model), encoding, per_db), len(drafts)

    return run


@pytest.mark.parametrize("size", [30_000, 60_000, 85_000])
def test_fewer_splats_where_there_is_no_room(fit, size):
    count, encoding, draft, _ = fit(size)
    assert 0.9 * size <= draft <= 1.021 * size
    assert count < 9000
    assert encoding.attribute_psnr is None or encoding.attribute_psnr > USUAL


@pytest.mark.parametrize("per_db", [0.03, 0.045, 0.09])
def test_finer_steps_and_more_entries_where_there_is(fit, per_db):
    count, encoding, draft, _ = fit(130_000, per_db=per_db)
    assert 9000 == count
    assert 130_000 / 1.031 <= draft <= 1.021 * 130_000
    assert ENTRIES < encoding.codebook_size <= 9000 / 3


def test_what_fits_stays_as_it_is(fit):
    assert (9000, EncodeOptions("small"), 91_000, 1) == fit(92_000)


def test_what_the_user_chose_stays(fit):
    book = fit(130_000, options=EncodeOptions("small", codebook_size=512))[1]
    assert 512 == book.codebook_size
    assert book.attribute_psnr > USUAL
    exact = EncodeOptions("small", attribute_psnr=40.0)
    assert exact == fit(130_000, options=exact)[1]


def test_renders_are_as_good_as_the_scene_at_some_precision(fit):
    _, encoding, _, drafts = fit(10**7)
    assert tuning_run._FINEST == encoding.attribute_psnr
    assert 2 == drafts
