# SPDX-License-Identifier: Apache-2.0
"""Simple strategies: kept splats, sizes by hand, and verified files."""

import numpy as np
import pytest
from checked import measure_errors

from csplat import Context, EncodeOptions
from csplat.decoder import decode_scene
from csplat.encoder.error_bounds import covariance_errors
from csplat.errors import InputError
from csplat.scene import drop_bands
from csplat_bench.reductions import ATTRIBUTES, Reduction, cluster_attributes, encode_reduced, prune_opacity
from csplat_conformance.declared_bounds import Source, verify_bounds


@pytest.fixture
def source(make_model):
    return make_model(150, 2)


def stored(source, result):
    """Verify a file against its source; return the decoded scene."""
    scene = decode_scene(result.data)
    proof = verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, result.source_index)
    assert () == proof.failures
    assert proof.rms_verified
    bounds = scene.declared_bounds
    assert (len(source), source.sh_degree) == (bounds.source_count, bounds.source_sh_degree)
    return scene


def test_splats_above_the_threshold_are_kept_in_order(source):
    tenth = np.float32(0.1)  # above the float64
    source.opacities[:6] = [*np.float32([0.0, 1.0]), np.nextafter(tenth, np.float32(0)), tenth, 0.05, 0.2]
    pruned, rows = prune_opacity(source, 0.1)
    assert np.int64 == rows.dtype
    assert [1, 3, 5] == rows[:3].tolist()
    assert np.flatnonzero(source.opacities >= tenth).tolist() == rows.tolist()
    np.testing.assert_array_equal(source.means[rows], pruned.means)
    np.testing.assert_array_equal(source.shN[rows], pruned.shN)
    source.opacities[:] = 0.5
    with pytest.raises(InputError, match=r"no splat has an opacity above 0\.5: the largest is 0\.5"):
        prune_opacity(source, 0.5)


def test_clusters_of_equal_values_are_found(make_model):
    model = make_model(300, 0)
    centres = np.float32([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 900]])
    which = np.arange(300) % 4
    model.means[:] = centres[which]
    model.opacities[:] = np.float32([0.1, 0.3, 0.5, 1.0])[which]
    found, report = cluster_attributes(model, 4)
    np.testing.assert_array_equal(model.means, found.means)
    np.testing.assert_allclose(model.opacities, found.opacities, atol=1e-7)
    assert {"sizes": [4], "error_share": 0.0} == report["means"]


def test_entries_are_the_means_of_their_splats(source):
    found, report = cluster_attributes(source, 7)
    entries, index = np.unique(found.sh0, axis=0, return_inverse=True)
    assert 7 == len(entries)
    for number, entry in enumerate(entries):
        members = source.sh0[index.reshape(-1) == number].astype(np.float64)
        np.testing.assert_allclose(members.mean(axis=0), entry, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1.0, atol=1e-6)
    assert 7 >= len(np.unique(found.quats, axis=0))
    told = []
    _, whole = cluster_attributes(source, 1, context=Context(progress=lambda *step: told.append(step)))
    assert 1.0 == pytest.approx(whole["means"]["error_share"])
    assert 0.0 < report["means"]["error_share"] < 1.0
    assert ("clustering", 1.0) == told[-1]


def test_an_entry_per_splat_changes_nothing_but_the_order_of_axes(source):
    found, _ = cluster_attributes(source, 150)
    for name in ("means", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(source, name), getattr(found, name))
    largest, _ = covariance_errors(source.quats.T, source.scales.T, found.quats.T, found.scales.T)
    assert largest < 1e-5
    assert (np.diff(found.scales, axis=1) <= 0).all()


@pytest.mark.slow
def test_clusters_do_not_depend_on_threads(make_model):
    one, two = (cluster_attributes(make_model(1000, 1), 50, context=Context(threads=count))[0] for count in (1, 2))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_scenes_of_0_and_1_splats_are_clustered(make_model):
    for count in (0, 1):
        assert count == len(cluster_attributes(make_model(count, 1), 5)[0])


def test_a_pruned_file_is_verified_and_records_the_reduction(source):
    result = encode_reduced(source, Reduction(prune_opacity=0.5, sh_degree=1))
    scene = stored(source, result)
    assert {"splats": 150, "prune_opacity": 0.5, "sh_degree": 1, "sh": "truncated"} == scene.options["reduced"]
    bounds = scene.declared_bounds
    assert (int(np.sum(source.opacities <= 0.5)), False) == (bounds.pruned_count, bounds.refitted)
    assert (source.opacities[result.source_index] > 0.5).all()
    measures = [record.measure for record in scene.declared_bounds.records]
    assert ["means", "covariance", "opacities", "sh0", "sh1", "sh2"] == measures
    assert 1 == scene.model.sh_degree
    by_encoder = stored(source, encode_reduced(source, Reduction(), EncodeOptions(sh_degree=0)))
    assert (0, "truncated") == (by_encoder.model.sh_degree, by_encoder.options["reduced"]["sh"])


@pytest.mark.slow
def test_a_clustered_file_declares_its_errors_against_the_source(source):
    reduction, options = Reduction(prune_opacity=0.2, sh_degree=1, kmeans=24), EncodeOptions(attribute_psnr=60.0)
    result = encode_reduced(source, reduction, options)
    assert result.data == encode_reduced(source, reduction, options).data
    scene = stored(source, result)
    assert 6 == len(scene.declared_bounds.records)
    clustered, _ = cluster_attributes(drop_bands(prune_opacity(source, 0.2)[0], 1), 24)
    rows = np.searchsorted(np.flatnonzero(source.opacities > 0.2), result.source_index)
    by_coding = measure_errors(clustered, scene.model, rows)
    rms = {record.measure: record.rms for record in scene.declared_bounds.records}
    assert rms["sh0"] > 5 * by_coding["sh0"][1]  # clustering causes most of the error
    assert by_coding["means"][0] < 0.1
    report = scene.options["reduced"]["kmeans"]
    assert set(ATTRIBUTES) == set(report)
    assert [24] == report["sh0"]["sizes"]


def test_impossible_reductions_are_refused(make_model):
    model = make_model(20, 1)
    for call, message in (
        (lambda: encode_reduced(model, Reduction(prune_opacity=0.9999)), "no splat has an opacity above"),
        (lambda: Reduction(prune_opacity=1.5), "the opacity to prune by is 1.5"),
        (lambda: Reduction(sh_degree=5), "sh_degree is 5"),
        (lambda: Reduction(kmeans=0), "kmeans is 0, expected 1 to 65536"),
    ):
        with pytest.raises(InputError, match=message):
            call()
