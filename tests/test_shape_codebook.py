"""Codebooks of shapes: files that both decoders read, smaller than without, the same at any number of threads."""

import os
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from checked import encoded
from chromium import absent

import csplat
from csplat import _spec
from csplat.decoder import decode_scene
from csplat.encoder import EncodeOptions, EncodePlan, Importance, encode_tiles, encode_with_report
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.quantisation import canonicalise_shape
from csplat.encoder.shape_codebook import mean_axes, unit_covariances
from csplat.errors import InputError
from csplat.model import normalise_quats
from csplat_conformance.adapter import answer
from csplat_selftest.decoder_processes import JsDecoder
from csplat_selftest.fuzzing.decoder_targets import compared


def few_shapes(make_model, count=2500, kinds=12, seed=0, degree=1, **fields):
    """A model whose splats have a few shapes, up to size and a little noise."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, kinds, count)
    quats = normalise_quats(rng.normal(size=(kinds, 4)))[kind] + rng.normal(0, 0.01, (count, 4))
    scales = rng.normal(0, 1, (kinds, 3))[kind] + rng.normal(-4, 0.7, (count, 1)) + rng.normal(0, 0.02, (count, 3))
    arrays = {"quats": normalise_quats(quats.astype(np.float32)), "scales": scales.astype(np.float32)}
    return make_model(count, degree, **{**arrays, **fields})


def seen_more(model, seed=1):
    """Weights and matrices as cameras might give them."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(len(model), 6, 3))
    matrices = roots @ roots.transpose(0, 2, 1)
    matrices *= (6 / np.einsum("nii->n", matrices))[:, None, None]
    weights = rng.lognormal(0, 2, len(model))
    rows, columns = np.triu_indices(6)
    return Importance(weights, weights, None, matrices[:, rows, columns])


def books(data):
    return [book for book in decode_scene(data).header.codebooks if book.kind == _spec.CODEBOOK_KIND_SHAPE]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tile_splats", "escapes"), [(65536, None), (65536, 0.3), (65536, 0.0), (500, 0.0), (500, None)]
)
@pytest.mark.parametrize("matrices", [False, True])
def test_comes_back_smaller_and_within_stated_errors(make_model, matrices, tile_splats, escapes):
    model = few_shapes(make_model, 1200)
    importance = seen_more(model) if matrices else None
    options = {"sh_coding": "none", "tile_splats": tile_splats}
    plain = encode_with_report(model, EncodeOptions(**options), importance=importance)
    result, _ = encoded(model, importance, shape_codebook_size=64, shape_escape_fraction=escapes, **options)
    assert len(result.data) < len(plain.data)
    assert 1 <= result.report.options["shape_codebook_size"] <= 64
    assert [result.report.options["shape_codebook_size"]] == [book.size for book in books(result.data)]


def test_stands_beside_codebooks_of_colour(make_model):
    model = few_shapes(make_model, 1000, degree=2)
    for coding in ("codebook", "scalar"):
        result, decoded = encoded(model, sh_coding=coding, shape_codebook_size=32)
        assert 1 == len(books(result.data))
        assert 2 == decoded.sh_degree


@pytest.mark.parametrize("count", [0, 1, 5, 60, 1000])
def test_is_never_larger_than_without(make_model, count):
    model = make_model(count, 1)  # random shapes: nothing to gain
    plain, _ = encoded(model)
    result, _ = encoded(model, shape_codebook_size=4096)
    assert len(result.data) <= len(plain.data) + len('"shape_codebook_size":4096,')  # it records the requested options
    if count < 1000:
        assert not books(result.data)


def test_splats_of_one_shape_share_an_entry(make_model):
    model = few_shapes(make_model, 1000, 1)
    result, decoded = encoded(model, shape_codebook_size=1, shape_escape_fraction=0.0, sh_coding="none")
    rotations = {tuple(row) for row in decoded.quats}
    assert 1 == len(rotations)
    trace = [0.5 * np.log(np.exp(2.0 * m.scales.astype(np.float64)).sum(axis=1)) for m in (model, decoded)]
    step = result.report.options["scale_step"]
    assert np.abs(trace[0][result.source_index] - trace[1]).max() <= 0.5 * step * (1 + 1e-6)


def test_no_entry_is_dead_and_frequent_ones_come_first(make_model):
    model = few_shapes(make_model, 1500, kinds=40)
    result, decoded = encoded(model, seen_more(model), shape_codebook_size=120, sh_coding="none")
    (book,) = books(result.data)
    shapes, counts = np.unique(decoded.quats, axis=0, return_counts=True)
    assert book.size <= 120
    assert len(shapes) >= 0.5 * book.size  # entries of one rotation may differ in scales
    assert counts.max() > 1


def test_what_weighs_more_is_served_better(make_model):
    model = make_model(3000, 0)
    heavy = np.arange(3000) % 10 == 0
    importance = Importance(np.ones(3000), np.where(heavy, 1.0, 1e-4))
    options = {"shape_codebook_size": 100, "shape_escape_fraction": 0.0}
    result, decoded = encoded(model, importance, **options)
    errors = covariance_entries(decoded.quats.T, np.exp(2.0 * decoded.scales.T.astype(np.float64)))
    source = model.select(result.source_index)
    wanted = covariance_entries(source.quats.T, np.exp(2.0 * source.scales.T.astype(np.float64)))
    relative = np.linalg.norm(errors - wanted, axis=0) / np.linalg.norm(wanted, axis=0)
    chosen = heavy[result.source_index]
    assert np.median(relative[chosen]) < 0.8 * np.median(relative[~chosen])


def test_huge_scales_leave_their_tile_without(make_model):
    model = few_shapes(make_model, 1200)
    scales = model.scales.copy()
    scales[17] = 3e8
    result, _ = encoded(replace(model, scales=scales), shape_codebook_size=16, tile_splats=500, scale_step=0.05)
    assert books(result.data)


def test_the_scene_of_a_draft_has_the_decoded_shapes(make_model):
    draft = EncodePlan.of(few_shapes(make_model, degree=0), EncodeOptions(shape_codebook_size=16))
    result = encode_tiles(draft).write()
    decoded = csplat.decode(result.data)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(draft.scene, name)[result.source_index], getattr(decoded, name))


def test_matrices_that_do_not_fit_are_refused(make_model):
    model = few_shapes(make_model, 200)
    for bad in (np.ones((200, 20)), np.ones((199, 21)), np.ones((200, 21), int), np.full((200, 21), np.nan)):
        with pytest.raises(InputError, match="shape matrices"):
            encode_with_report(
                model, EncodeOptions(shape_codebook_size=4), importance=Importance(np.ones(200), None, None, bad)
            )


def test_axes_of_covariances_come_back():
    rng = np.random.default_rng(0)
    quats, scales = normalise_quats(rng.normal(size=(300, 4)).astype(np.float32)), rng.normal(0, 1, (300, 3))
    covariances, sizes = unit_covariances(quats.T, scales.T)
    np.testing.assert_allclose(1.0, covariances[:3].sum(axis=0), rtol=1e-12)
    rotation, found = canonicalise_shape(*mean_axes(covariances))
    again, zero = unit_covariances(rotation, found)
    np.testing.assert_allclose(covariances, again, atol=1e-6)
    np.testing.assert_allclose(0.0, zero, atol=1e-6)
    np.testing.assert_allclose(np.sort(scales - sizes[:, None], axis=1), np.sort(found.T, axis=1), atol=1e-3)


#: SHA-256 of files with codebooks of both kinds, made with an importance and without.
DIGEST = """
import hashlib, sys
import numpy as np
from csplat import EncodeOptions, SplatModel
from csplat.encoder import Importance, encode_with_report
from csplat.model import normalise_quats

def digest(threads):
    rng = np.random.default_rng(4)
    n = 1500
    normal = lambda *shape: rng.standard_normal((n, *shape)).astype(np.float32)
    model = SplatModel(means=normal(3), quats=normalise_quats(normal(4)), scales=normal(3) - 4,
                       opacities=rng.random(n).astype(np.float32), sh0=normal(3), shN=normal(8, 3))
    def matrices(size):
        roots = rng.normal(size=(n, size, 3))
        full = roots @ roots.transpose(0, 2, 1) / 3
        rows, columns = np.triu_indices(size)
        return full[:, rows, columns]
    importance = Importance(rng.random(n), rng.random(n), matrices(8), matrices(6))
    options = EncodeOptions(sh_coding="codebook", codebook_size=64, shape_codebook_size=150, tile_splats=1000,
                            threads=threads)
    made = [encode_with_report(model, options, importance=one) for one in (importance, None)]
    assert all(one.report.options["codebook_size"] and one.report.options["shape_codebook_size"] for one in made)
    return [hashlib.sha256(one.data).hexdigest() for one in made]

if __name__ == "__main__":
    print(*digest(3))
"""


@pytest.mark.slow
def test_same_bytes_at_any_number_of_threads(tmp_path):
    program = tmp_path / "digest.py"
    program.write_text(DIGEST)
    blas = "1" if (os.cpu_count() or 1) > 1 else "2"  # another number than here
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": blas, "OMP_NUM_THREADS": blas}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
    assert runpy.run_path(str(program))["digest"](1) == done.stdout.split()


@pytest.mark.slow
def test_the_javascript_decoder_reads_them_too(make_model):
    if shutil.which("node") is None:
        absent("the JavaScript decoder needs Node.js, which is not installed")
    model = few_shapes(make_model, 600, degree=2)
    importance = seen_more(model)
    with JsDecoder() as decoder:
        for options in (
            {"shape_escape_fraction": 0.3, "tile_splats": 250},
            {"shape_escape_fraction": 0.0},
            {"sh_coding": "codebook", "codebook_size": 16},
        ):
            result, _ = encoded(model, importance, shape_codebook_size=40, **options)
            assert books(result.data)
            assert ("decoded", "") == compared(answer(result.data), decoder.ask(result.data), "JavaScript"), options
