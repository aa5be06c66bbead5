# SPDX-License-Identifier: Apache-2.0
"""The encoder suite's checks of the errors that a file declares, and when renders must be compared instead.

Also: csplat_conformance.encoders.render_checks.
"""

import types
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from encoder_runs_cases import COMMAND, INPUTS, L3, PLAIN, judged, model_of, running

import csplat
from csplat.context import Context
from csplat.decoder import decode_scene
from csplat.encoder import quantisation, shape_codebook
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source, measure_pairs, verify_bounds
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder
from csplat_conformance.encoders.error_checks import find_truncation
from csplat_conformance.encoders.file_checks import check_content, pair_splats


def declaring(change=tuple, **facts):
    """Return a change of the records that a scene declares, and of other facts of its errors."""

    def changed(scene):
        declared = scene.declared_bounds
        return replace(scene, declared_bounds=replace(declared, records=tuple(change(declared.records)), **facts))

    return changed


def without(*names):
    return lambda records: (record for record in records if record.measure not in names)


def halved(records):
    return (replace(record, max=record.max / 2, rms=record.rms / 2) for record in records)


def silent(scene):
    return replace(scene, declared_bounds=None)


def unchanged(scene):
    return scene


REFITTED = declaring(without("sh0", "sh1"), refitted=True)


def test_errors_are_not_proved_if_they_are_not_declared_or_attributes_are_refitted(plain, tmp_path):
    empty = model_of("nasty/empty", tmp_path)
    for name, model, change, status, message, alone in (
        (PLAIN, plain, silent, Status.NOT_PROVED, "the file declares no bounds", "the file declares no bounds"),
        (PLAIN, plain, REFITTED, Status.NOT_PROVED, "sh0, sh1: refitted, no bound is declared", "sh0, sh1 refitted"),
        ("nasty/empty", empty, silent, Status.PASSED, "", ""),
        (PLAIN, plain, declaring(without("sh1")), Status.FAILED, "the file declares no bound for sh1", ""),
    ):
        _, errors, found = judged(name, model, change)
        assert (status, message, alone) == (errors.status, errors.message, found)
    assert ("SER-6",) == errors.clauses


def test_declared_errors_hold_for_refitted_attributes_too(plain):
    assert judged(PLAIN, plain, REFITTED)[1].details["means"]["holds"]
    _, errors, _ = judged(PLAIN, plain, declaring(halved, refitted=True))
    assert (Status.FAILED, ("SER-5",)) == (errors.status, errors.clauses)
    assert errors.message.startswith("means: max ")
    assert ", source splat " in errors.message
    assert errors.message.endswith("; and 8 more")
    assert {"splat", "tile", "source_splat", "found"} == set(errors.details["sh1"]["worst"])


def honest(model):
    """Let a scene declare its true errors."""

    def change(scene):
        means = (one.means.astype(np.float64) for one in (model, scene.model))
        index = pair_splats(*means, INPUTS[PLAIN].separation).source_index
        true = {name: one[:2] for name, one in measure_pairs(Source.of(model), scene.model, index).items()}
        return declaring(
            lambda records: (replace(one, max=true[one.measure][0], rms=true[one.measure][1]) for one in records)
        )(scene)

    return change


def test_coarse_files_and_large_errors_that_are_declared_cause_a_warning(plain):
    _, errors, _ = judged(PLAIN, plain, attribute_psnr=14.0, sh_coding="none")
    assert (Status.WARNED, True) == (errors.status, "is coarse: splat " in errors.message)
    for name, change, message in (
        ("opacities", lambda alpha: 1 / (1 + np.exp(-alpha)), "opacities: an error of 0.49"),
        ("scales", np.exp, "covariance: an error of "),
        ("sh0", lambda sh0: np.clip(sh0, -0.5, 0.5), "sh0: an error of 0."),
        ("shN", lambda shN: 0 * shN, "sh1: an error of 0."),
    ):
        wrong = replace(plain, **{name: np.asarray(change(getattr(plain, name)), np.float32)})
        _, errors, _ = judged(PLAIN, wrong, honest(plain), attribute_psnr=60.0)
        assert Status.WARNED is errors.status
        assert all(words in errors.message for words in (message, "beyond", "source splat")), name


def statuses(report):
    return [(one.level, one.status) for one in report.outcomes]


@pytest.mark.parametrize(("change", "why"), [(silent, "the file declares no bounds"), (REFITTED, "sh0, sh1 refitted")])
def test_pictures_judge_at_any_level_where_errors_prove_nothing(altered, change, why):
    seen, bad, blind = (altered(change, render_score=score) for score in (lambda *_: 41.0, lambda *_: 11.0, None))
    passed, open_ = Status.PASSED, Status.NOT_PROVED
    assert seen.passed
    assert [("L1", passed), ("L2", passed), ("L3", open_), ("L4", passed)] == statuses(seen)
    assert ("L4", Status.FAILED) == statuses(bad)[-1] == statuses(blind)[-1]
    assert f"{why}: only renders can check it, and no renderer" == blind.outcomes[-1].message


def test_pictures_are_requested_where_they_are_needed_at_the_level_of_errors(altered):
    assert ["L1", "L2"] == [level for level, _ in statuses(altered(silent, ("L1", "L2")))]
    for last, arguments, fields in (
        (("L3", Status.NOT_PROVED), (silent,), {"renders": False}),
        (("L4", Status.SKIPPED), (silent, ("L3", "L4"), lambda *_: 9.0), {"renders": False}),
        (("L3", Status.PASSED), (unchanged,), {}),
        (("L4", Status.SKIPPED), (unchanged, ("L4",)), {}),
        (("L4", Status.FAILED), (unchanged, ("L4",), lambda *_: float("nan")), {}),
    ):
        assert last == statuses(altered(*arguments, **fields))[-1]


def test_a_scene_that_cannot_be_drawn_fails_alone(altered):
    def far(scene):
        return replace(scene, model=replace(scene.model, origin=(1e300, 0.0, 0.0)))

    report = altered(far, (*L3, "L4"), lambda *_: 40.0)
    assert [Status.FAILED] == [one.status for one in report.outcomes if one.level == "L4"]


def test_errors_are_proved_by_the_encoders_own_index(monkeypatch):
    # Centres are equal: only the encoder knows the pairs.
    spy = mock.Mock(wraps=verify_bounds)
    monkeypatch.setattr("csplat_conformance.encoders.error_checks.verify_bounds", spy)
    one = INPUTS["nasty/duplicates"]
    means = one.source().means
    result = csplat.encode(one.source().to_model((0.0, 0.0, 0.0)))
    pairs = pair_splats(means.astype(np.float64), csplat.decode(result).means.astype(np.float64), one.separation)
    exchanged = pairs.source_index.copy()
    same = np.flatnonzero((means[exchanged] == means[exchanged[0]]).all(axis=1))
    exchanged[same] = np.roll(exchanged[same], 1)
    run = running((result, exchanged), lambda _: None)
    assert run_encoder(COMMAND, EncoderSuiteOptions(one.name, ("L3",)), run=run).passed
    np.testing.assert_array_equal(exchanged, spy.call_args.args[-1])


@contextmanager
def rounding(rint):
    """Make our encoder round in another way."""
    numpy = types.ModuleType("numpy")
    vars(numpy).update(vars(np), rint=rint)
    with mock.patch.object(quantisation, "np", numpy), mock.patch.object(shape_codebook, "np", numpy):
        yield


@pytest.mark.parametrize("cut", [np.floor, np.trunc])
@pytest.mark.parametrize("name", ["ordinary/degree_3", "ordinary/quaternions"])
def test_cut_values_are_distinguished_from_rounded_values(tmp_path, name, cut):
    one, model = INPUTS[name], model_of(name, tmp_path)
    with rounding(lambda values, out=None: cut(values, out=out)):
        data = csplat.encode(model, csplat.EncodeOptions(sh_coding="scalar"), context=Context(threads=1))
        scene = decode_scene(data)
    _, pairs = check_content(one, one.source(), scene, None)
    every = frozenset(("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3"))
    lines = find_truncation(one.source(), scene.model, scene.header, pairs.source_index, every)
    assert ["means", "opacities", "scales", "quats", "sh0"] == [line.partition(":")[0] for line in lines][:5]
    assert all(line.endswith("truncated instead of rounded?") for line in lines), lines
    assert [] == find_truncation(one.source(), scene.model, scene.header, pairs.source_index, frozenset())


@pytest.mark.parametrize("name", ["ordinary/strong_colours", "ordinary/needles_and_discs"])
def test_coarse_steps_are_not_cuts(tmp_path, name):
    model = model_of(name, tmp_path)
    for preset, psnr in (("fast", 20.0), ("balanced", 30.0), ("small", 20.0), ("small", 90.0)):
        _, errors, _ = judged(name, model, preset=preset, attribute_psnr=psnr)
        assert "truncated" not in errors.message
