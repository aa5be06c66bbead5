# SPDX-License-Identifier: Apache-2.0
"""Codebooks: k-means finds near entries at any thread count; codebooks of shapes make smaller files.

Also: csplat.encoder.shape_codebook.
"""

from __future__ import annotations

import ast
import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from checked import encoded
from codebooks_cases import exact, few_shapes, scene

import csplat
from csplat import _spec
from csplat.context import Context
from csplat.decoder import decode_scene
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, Importance
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.kmeans import assign, cluster, rank_by_frequency, reassign_by_metric, refine_by_metric
from csplat.encoder.quantisation import canonicalise_shape
from csplat.encoder.shape_codebook import mean_axes, unit_covariances
from csplat.errors import InputError
from csplat.model import normalise_quats


def blobs(count=3000, width=9, centres=40, spread=3.0, seed=0):
    rng = np.random.default_rng(seed)
    middle = rng.integers(-90, 91, (centres, width))
    noise = rng.normal(0, spread, (count, width))
    points = np.rint(middle[rng.integers(0, centres, count)] + noise).astype(np.int16)
    return points, rng.random(count).astype(np.float32)


def distortion(points, weights, entries, index):
    """Return the weighted mean of squared distances of points from their entries."""
    squares = ((points.astype(np.float64) - entries[index]) ** 2).sum(1)
    return float((squares * weights).sum() / weights.sum(dtype=np.float64))


def clustered(points, weights, size, *, iterations=3, **options):
    """Cluster points; assert that the entries are distinct and used."""
    entries, index = cluster(points, weights, size, iterations=iterations, **options)
    assert (np.int32, np.uint32) == (entries.dtype, index.dtype)
    assert len(index) == len(points)
    assert len(np.unique(entries, axis=0)) == len(entries) <= size
    np.testing.assert_array_equal(np.arange(len(entries)), np.unique(index))
    return entries, index


def test_clusters_are_distinct_used_and_close():
    points, weights = blobs()
    for dtype, near_groups in ((np.int16, 0), (np.int32, 0), (np.int16, 5)):
        points = points.astype(dtype)
        entries, index = clustered(points, weights, 40, iterations=6, near_groups=near_groups)
        assert len(entries) == 40
        assert distortion(points, weights, entries, index) < 2.0 * 9 * 3.0**2
    points, weights = blobs(2000, 9, 30, 2.0)
    large = points.astype(np.int32) * 1000  # beyond the exact norm, on a coarser lattice
    assert distortion(large, weights, *clustered(large, weights, 30, iterations=5)) < 2.0 * 9 * 2000.0**2


def test_more_iterations_and_entries_lower_the_distortion():
    points, weights = blobs(spread=30.0)
    few, short, long, many = (
        distortion(points, weights, *clustered(points, weights, size, iterations=iterations))
        for size, iterations in ((64, 0), (64, 4), (64, 10), (256, 4))
    )
    assert long < few
    assert many < 0.9 * short


def test_first_entries_beat_uniform_ones():
    (points, _), weights = blobs(6000, 9, 200, 2.0), np.ones(6000, np.float32)
    points[:4000] = points[0] + np.random.default_rng(4).integers(-2, 3, (4000, 9))
    uniform = points[np.random.default_rng(5).choice(6000, 200, replace=False)].astype(np.int32)
    found = distortion(points, weights, *clustered(points, weights, 200, iterations=0))
    assert found < 0.5 * distortion(points, weights, uniform, assign(points, uniform))


def test_heavy_points_keep_their_values():
    points, _ = blobs(5000, 6, 500, 20.0)
    weights = np.full(5000, 1e-12, np.float32)
    heavy = np.arange(0, 5000, 250)
    weights[heavy] = 1e6
    entries, index = clustered(points, weights, 64, iterations=4, sample_per_entry=8)
    np.testing.assert_array_equal(points[heavy], entries[index[heavy]])


def test_weights_matter_by_ratio_and_zeros_are_equal_weights():
    points, weights = blobs(1000)
    equal = np.ones(1000, np.float32)
    for one, same in ((weights, weights * np.float32(2**-40)), (equal, 0 * equal)):
        np.testing.assert_equal(clustered(points, same, 30), clustered(points, one, 30))
    for positive in (0, 1, 5, 20):  # few positive weights give no unused entry
        clustered(points[:500], (np.arange(500) < positive) * np.float32(2.0), 16, sample_per_entry=2)


def test_fewer_values_than_entries_are_kept_exactly():
    values = blobs(16, 5)[0]
    for value_count, point_count in ((0, 0), (1, 1), (7, 7), (16, 16), (1, 900), (10, 900)):
        points = values[np.arange(point_count) % max(value_count, 1)]
        for near_groups in (0, 2):
            entries, index = clustered(points, np.ones(point_count, np.float32), 16, near_groups=near_groups)
            assert len(entries) <= max(value_count, 1)
            np.testing.assert_array_equal(points, entries[index])


def test_invalid_arguments_are_refused():
    points, weights = blobs(50)
    cases = [(points, bad, 8, "weights") for bad in (weights[:-1], -weights, weights * np.inf, weights * np.nan)]
    cases += [(bad, weights, 8, "points") for bad in (points.astype(np.float32), points[0], points[:, :0])]
    for given, by, size, message in (*cases, (points, weights, 0, "size")):
        with pytest.raises(InputError, match=message):
            cluster(given, by, size, iterations=1)
    for shape, message in (((0, 9), "no entries"), ((4, 8), "entries")):
        with pytest.raises(InputError, match=message):
            assign(points, np.empty(shape, np.int32))


def test_ranks_follow_frequency_and_keep_the_order_of_equals():
    index = np.array([3, 3, 1, 0, 1, 2, 3], np.uint32)
    entries = np.array([[10], [11], [12], [13], [14]], np.int32)
    ranked, ordered = rank_by_frequency(index, entries)
    assert [0, 0, 1, 2, 1, 3, 0] == ranked.tolist()
    assert [13, 11, 10, 12, 14] == ordered.ravel().tolist()
    assert ranked.dtype == np.uint32
    np.testing.assert_array_equal(entries[index], ordered[ranked])


def test_reassigning_over_all_entries_finds_the_best():
    points, matrices, metric, entries = scene()
    errors = np.stack([exact(points - entry, matrices, np.ones(len(points))) for entry in entries], axis=1)
    found = reassign_by_metric(
        points, metric, entries, np.zeros(len(points), np.int64), Context(threads=2), len(entries)
    )
    np.testing.assert_allclose(errors.min(axis=1), errors[np.arange(len(points)), found], rtol=1e-4)


def test_refining_reduces_errors_without_unused_entries():
    points, _, metric, entries = scene()
    start = np.linalg.norm((points[:, None] - entries).reshape(len(points), len(entries), -1), axis=2).argmin(axis=1)
    moved, index = refine_by_metric(points, metric, entries, start, Context(threads=1))
    before = metric.errors(points - entries[start], slice(None)).sum()
    assert metric.errors(points - moved[index], slice(None)).sum() < 0.8 * before
    assert set(range(len(moved))) == set(index.tolist())
    assert len(moved) == len(np.unique(moved.reshape(len(moved), -1), axis=0))


def seen_more(model):
    """Return random weights and matrices."""
    weights = np.random.default_rng(1).lognormal(0, 2, len(model))
    return Importance(weights, weights, None, scene(len(model), 6)[2].triangles)


def books(data):
    return [book for book in decode_scene(data).header.codebooks if book.kind == _spec.CODEBOOK_KIND_SHAPE]


@pytest.mark.slow
def test_shape_codebooks_make_files_smaller_within_declared_errors(make_model):
    model = few_shapes(make_model, 1200)
    for importance, tile_splats, escapes in (
        (None, 65536, None), (None, 500, 0.0), (seen_more(model), 65536, 0.3), (seen_more(model), 500, None),
    ):  # fmt: skip
        options = {"sh_coding": "none", "tile_splats": tile_splats}
        plain = encode_with_report(model, EncodeOptions(**options), importance=importance)
        result, _ = encoded(model, importance, shape_codebook_size=64, shape_escape_fraction=escapes, **options)
        assert len(result.data) < len(plain.data)
        assert 1 <= result.report.options["shape_codebook_size"] <= 64
        assert [result.report.options["shape_codebook_size"]] == [book.size for book in books(result.data)]


def test_a_shape_codebook_never_makes_a_file_larger(make_model):
    for count in (0, 1, 60, 800):
        model = make_model(count, 0)  # random shapes gain nothing
        plain = encode_with_report(model).data
        coded = encode_with_report(model, EncodeOptions(shape_codebook_size=4096)).data
        assert len(coded) <= len(plain) + len('"shape_codebook_size":4096,')  # it records the requested options
        assert count > 100 or not books(coded)


def test_splats_of_one_shape_share_an_entry(make_model):
    model = few_shapes(make_model, 1000, 1)
    result, decoded = encoded(model, shape_codebook_size=1, shape_escape_fraction=0.0, sh_coding="none")
    assert 1 == len({tuple(row) for row in decoded.quats})
    trace = [0.5 * np.log(np.exp(2.0 * m.scales.astype(np.float64)).sum(axis=1)) for m in (model, decoded)]
    step = result.report.options["scale_step"]
    assert np.abs(trace[0][result.source_index] - trace[1]).max() <= 0.5 * step * (1 + 1e-6)


def test_important_shapes_have_smaller_errors(make_model):
    model = make_model(3000, 0)
    heavy = np.arange(3000) % 10 == 0
    importance = Importance(np.ones(3000), np.where(heavy, 1.0, 1e-4))
    result, decoded = encoded(model, importance, shape_codebook_size=100, shape_escape_fraction=0.0)
    source = model.select(result.source_index)
    found, wanted = (
        covariance_entries(one.quats.T, np.exp(2.0 * one.scales.T.astype(np.float64))) for one in (decoded, source)
    )
    relative = np.linalg.norm(found - wanted, axis=0) / np.linalg.norm(wanted, axis=0)
    chosen = heavy[result.source_index]
    assert np.median(relative[chosen]) < 0.8 * np.median(relative[~chosen])


def test_axes_are_recovered_from_covariances():
    rng = np.random.default_rng(0)
    quats, scales = normalise_quats(rng.normal(size=(300, 4)).astype(np.float32)), rng.normal(0, 1, (300, 3))
    covariances, sizes = unit_covariances(quats.T, scales.T)
    np.testing.assert_allclose(1.0, covariances[:3].sum(axis=0), rtol=1e-12)
    rotation, found = canonicalise_shape(*mean_axes(covariances))
    again, zero = unit_covariances(rotation, found)
    np.testing.assert_allclose(covariances, again, atol=1e-6)
    np.testing.assert_allclose(0.0, zero, atol=1e-6)
    np.testing.assert_allclose(np.sort(scales - sizes[:, None], axis=1), np.sort(found.T, axis=1), atol=1e-3)


def digests(threads):
    """Return SHA-256s of clusters by two kinds of search, and of files with both kinds of codebooks."""
    context = Context(threads=threads, seed=7)
    points, weights = blobs(1500, 45, 150, 12.0)
    made = []
    for near_groups, scale in ((0, 1), (6, 1), (0, 300)):
        scaled = points.astype(np.int32) * scale
        entries, index = cluster(scaled, weights, 100, iterations=3, near_groups=near_groups, context=context)
        made.append(entries.tobytes() + index.tobytes())
    rng, n = np.random.default_rng(4), 1200
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "sh0": (3,), "shN": (8, 3)}
    fields = {name: rng.standard_normal((n, *shape)).astype(np.float32) for name, shape in shapes.items()}
    fields |= {"quats": normalise_quats(fields["quats"]), "opacities": rng.random(n).astype(np.float32)}
    model = csplat.SplatModel(**fields)
    sizes = {"codebook_size": 64, "shape_codebook_size": 150}
    options = EncodeOptions(sh_coding="codebook", tile_splats=800, **sizes)
    matrices = [scene(n, size)[2].triangles for size in (9, 6)]
    for importance in (Importance(rng.random(n), rng.random(n), *matrices), None):
        result = encode_with_report(model, options, importance=importance, context=context)
        assert all(result.report.options[name] for name in sizes)
        made.append(result.data)
    return [hashlib.sha256(one).hexdigest() for one in made]


@pytest.mark.slow
def test_neither_threads_nor_compiled_code_change_the_bytes(tmp_path):
    # The threads of an OpenBLAS that is not found cannot be set; an empty folder has no compiled library.
    code = "from csplat.encoder import entry_search; entry_search._openblas = lambda: None; import runpy"
    environment = {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(sys.path)}
    environment["CSPLAT_NATIVE_FOLDER"] = str(tmp_path)
    command = [sys.executable, "-c", f"{code}; print(runpy.run_path({__file__!r})['digests'](3))"]
    other = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=True)
    assert digests(1) == digests(2) == ast.literal_eval(other.stdout)
