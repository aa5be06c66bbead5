"""Simple strategies: what they keep, what they cost by hand, and that their files prove what they state."""

import json
import subprocess
import sys

import numpy as np
import pytest
from checked import measure_errors

from csplat import EncodeOptions, decode
from csplat.decoder import decode_scene
from csplat.encoder.error_bounds import covariance_errors
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_tools.study import (
    ATTRIBUTES,
    KMeans,
    Reduction,
    attribute_floats,
    cluster_attributes,
    encode_reduced,
    parse_kmeans,
    prune_opacity,
    reduce_model,
)


@pytest.fixture
def source(make_model):
    return make_model(150, 2)


@pytest.fixture(scope="module")
def shell():
    """A shell of overlapping splats, which pictures show."""
    pytest.importorskip("numba", reason="rendering wants the extra [render]")
    pytest.importorskip("PIL", reason="photographs want the extra [render]")
    from captures import shell

    return shell(8)


def stored(source, result):
    """Prove what a file states against the source; return what it decodes to."""
    scene = decode_scene(result.data)
    proof = verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, result.source_index)
    assert () == proof.failures
    assert proof.rms_verified
    assert (len(source), source.sh_degree) == (
        scene.declared_bounds.source_count,
        scene.declared_bounds.source_sh_degree,
    )
    return scene


# pruning


def test_splats_above_the_threshold_stay_in_their_order(source):
    source.opacities[:4] = np.float32([0.25, np.nextafter(np.float32(0.25), 1), 0.0, 1.0])
    pruned, rows = prune_opacity(source, 0.25)
    assert np.flatnonzero(source.opacities > 0.25).tolist() == rows.tolist()
    assert [1, 3] == rows[:2].tolist()
    assert np.int64 == rows.dtype
    np.testing.assert_array_equal(source.means[rows], pruned.means)
    np.testing.assert_array_equal(source.shN[rows], pruned.shN)


def test_the_threshold_is_not_rounded(source):
    below, above = np.float32(0.1), np.nextafter(np.float32(0.1), np.float32(1))  # float32's 0.1 is above 0.1
    source.opacities[:] = 0.0
    source.opacities[:3] = [np.nextafter(below, np.float32(0)), below, above]
    assert [1, 2] == prune_opacity(source, 0.1)[1].tolist()


def test_a_threshold_that_leaves_nothing_is_refused(source):
    source.opacities[:] = 0.5
    with pytest.raises(InputError, match=r"no splat has an opacity above 0\.5: the largest is 0\.5"):
        prune_opacity(source, 0.5)
    for tau in (-0.1, 1.0, float("nan")):
        with pytest.raises(InputError, match="the opacity to prune by is"):
            prune_opacity(source, tau)


# sizes


def test_sizes_are_those_of_the_published_rule(make_model):
    assert 14 == sum(attribute_floats(0).values())
    assert 92 * 1000 == reduce_model(make_model(1000, 1), Reduction()).size_bytes
    assert 56 * 1000 == reduce_model(make_model(1000, 1), Reduction(sh_degree=0)).size_bytes


def test_codebooks_are_counted_with_their_indices(make_model):
    model = make_model(1001, 1)
    found = cluster_attributes(model, KMeans({"means": 16, "sh0": 5, "shN": 1}, stages=2))
    sizes = found.attribute_bytes()
    assert {"means": (16, 16), "sh0": (5, 5), "shN": (1, 1)} == {n: book.sizes for n, book in found.books.items()}
    assert 2 * 16 * 3 * 4 + 1001 == sizes["means"]  # eight bits
    assert 2 * 5 * 3 * 4 + (1001 * 6 + 7) // 8 == sizes["sh0"]
    assert 2 * 9 * 4 == sizes["shN"]  # one entry needs no index
    assert 1001 * 16 == sizes["quats"]
    assert sum(sizes.values()) == found.size_bytes


# clustering


def test_as_many_entries_as_values_change_nothing(make_model):
    model = make_model(50, 1)
    found = cluster_attributes(model, KMeans(dict.fromkeys(ATTRIBUTES, 50), gauge=False)).model
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(model, name), getattr(found, name))
    np.testing.assert_array_equal(np.abs(model.quats), np.abs(found.quats))


def test_values_of_a_few_groups_find_them(make_model):
    model = make_model(300, 0)
    centres = np.float32([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 900]])
    which = np.arange(300) % 4
    model.means[:] = centres[which]
    model.opacities[:] = np.float32([0.1, 0.3, 0.5, 1.0])[which]
    found = cluster_attributes(model, KMeans({"means": 4, "opacities": 4}))
    np.testing.assert_array_equal(model.means, found.model.means)
    np.testing.assert_allclose(model.opacities, found.model.opacities, atol=1e-7)
    assert 0.0 == found.books["means"].error_share


def test_entries_are_the_means_of_their_splats(source):
    found = cluster_attributes(source, KMeans({"sh0": 7})).model
    entries, index = np.unique(found.sh0, axis=0, return_inverse=True)
    assert 7 == len(entries)
    for number, entry in enumerate(entries):
        members = source.sh0[index.reshape(-1) == number].astype(np.float64)
        np.testing.assert_allclose(members.mean(axis=0), entry, rtol=1e-5, atol=1e-6)


def test_more_entries_and_more_stages_err_less(source):
    def share(size, stages=1):
        return cluster_attributes(source, KMeans({"means": size}, stages)).books["means"].error_share

    assert 1.0 == pytest.approx(share(1))
    assert 1.0 > share(4) > share(32) > share(32, 2) > share(32, 3) > 0.0


def test_an_error_share_finds_the_smallest_codebook_that_meets_it(source):
    book = cluster_attributes(source, KMeans({"scales": 0.1})).books["scales"]
    (size,) = book.sizes
    assert book.error_share <= 0.1 < cluster_attributes(source, KMeans({"scales": size // 2})).books[
        "scales"
    ].error_share  # fmt: skip
    two = cluster_attributes(source, KMeans({"scales": 0.1}, stages=2)).books["scales"]
    assert two.error_share <= 0.1
    assert sum(two.sizes) < size


def test_what_no_codebook_serves_stays_as_it_is(source):
    found = cluster_attributes(source, KMeans({"means": 1e-9}))
    assert () == found.books["means"].sizes
    np.testing.assert_array_equal(source.means, found.model.means)
    assert 150 * 12 == found.attribute_bytes()["means"]


def test_rotations_are_unit_and_of_one_sign(source):
    source.quats[::2] *= -1
    plain = cluster_attributes(source, KMeans({"quats": 30}, stages=2, gauge=False)).model
    np.testing.assert_allclose(np.linalg.norm(plain.quats, axis=1), 1.0, atol=1e-6)
    assert 30 * 30 >= len(np.unique(plain.quats, axis=0))
    flipped = source.select(slice(None))
    flipped.quats[:] *= -1
    again = cluster_attributes(flipped, KMeans({"quats": 30}, stages=2, gauge=False)).model
    np.testing.assert_array_equal(plain.quats, again.quats)


def test_the_gauge_keeps_the_shapes(source):
    found = cluster_attributes(source, KMeans({"quats": 150})).model
    largest, _ = covariance_errors(source.quats.T, source.scales.T, found.quats.T, found.scales.T)
    assert largest < 1e-5
    assert (np.diff(found.scales, axis=1) <= 0).all()


@pytest.mark.slow
def test_clusters_do_not_depend_on_threads(make_model):
    model = make_model(3000, 1)
    one, two = (cluster_attributes(model, parse_kmeans("100"), threads=count).model for count in (1, 2))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_scenes_of_no_splat_and_of_one_can_be_clustered(make_model):
    for count in (0, 1):
        found = cluster_attributes(make_model(count, 1), parse_kmeans("0.5"))
        assert count == len(found.model)


@pytest.mark.parametrize("text", ["8", "0.2"])
def test_progress_rises_to_its_end(source, text):
    told = []
    cluster_attributes(source, parse_kmeans(text, stages=2), progress=lambda stage, done: told.append((stage, done)))
    shares = [done for _, done in told]
    assert {"clustering"} == {stage for stage, _ in told}
    assert shares == sorted(shares)
    assert (0.0, 1.0) == (shares[0], shares[-1])
    assert len(shares) > 12


def test_words_for_kmeans_are_understood():
    assert dict.fromkeys(ATTRIBUTES, 256) == parse_kmeans("256").sizes
    assert {**dict.fromkeys(ATTRIBUTES, 0.01), "means": 4096} == parse_kmeans("0.01, means=4096").sizes
    assert {"quats": 16, "sh0": 0.5} == parse_kmeans("quats=16,sh0=0.5").sizes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' is not a number"),
        ("means=many", "'many' is not a number"),
        ("xyz=3", "k-means of 'xyz', expected some of means, quats"),
        ("means=0", "means is 0, expected 1 to 65536 entries"),
        ("means=2.5", "means is 2.5"),
        ("70000", "means is 70000"),
        ("nan", "means is nan"),
        ("3,4", "two numbers for all"),
        ("means=3,means=4", "names means twice"),
    ],
)
def test_other_words_for_kmeans_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_kmeans(text)


# files


def test_a_pruned_file_proves_its_errors_and_says_what_is_gone(source):
    result = encode_reduced(source, Reduction(prune_opacity=0.5, sh_degree=1))
    scene = stored(source, result)
    assert {"splats": 150, "prune_opacity": 0.5, "sh_degree": 1, "sh": "truncated"} == scene.options["reduced"]
    assert (int(np.sum(source.opacities <= 0.5)), False) == (
        scene.declared_bounds.pruned_count, scene.declared_bounds.refitted,
    )  # fmt: skip
    assert (source.opacities[result.source_index] > 0.5).all()
    measures = [record.measure for record in scene.declared_bounds.records]
    assert ["means", "covariance", "opacities", "sh0", "sh1", "sh2"] == measures
    assert 1 == scene.model.sh_degree


def test_the_encoders_degree_is_the_reductions(source):
    scene = stored(source, encode_reduced(source, Reduction(), EncodeOptions(sh_degree=0)))
    assert (0, "truncated") == (scene.model.sh_degree, scene.options["reduced"]["sh"])


@pytest.mark.slow
@pytest.mark.parametrize("text", ["24", "0.1,means=60"])
def test_a_clustered_file_states_its_errors_against_the_source(source, text):
    kmeans = parse_kmeans(text, stages=2)
    reduction = Reduction(prune_opacity=0.2, sh_degree=1, kmeans=kmeans)
    result = encode_reduced(source, reduction, EncodeOptions(attribute_psnr=60.0))
    scene = stored(source, result)
    assert 6 == len(scene.declared_bounds.records)
    clustered = reduce_model(source, reduction).model
    by_coding = measure_errors(clustered, scene.model, np.searchsorted(
        np.flatnonzero(source.opacities > 0.2), result.source_index))  # fmt: skip
    rms = {record.measure: record.rms for record in scene.declared_bounds.records}
    assert rms["sh0"] > 5 * by_coding["sh0"][1]  # most of it comes from clustering
    said = scene.options["reduced"]["kmeans"]
    assert set(ATTRIBUTES) == set(said)
    assert 2 == len(said["sh0"]["sizes"])
    assert by_coding["means"][0] < 0.1


def test_a_file_is_the_same_each_time(source):
    reduction = Reduction(prune_opacity=0.2, kmeans=parse_kmeans("16"))
    assert encode_reduced(source, reduction).data == encode_reduced(source, reduction).data


@pytest.mark.slow
def test_a_distilled_degree_looks_more_like_the_source(shell):
    from captures import cameras, views_of

    from csplat_render.scorer import Scorer

    truncated = encode_reduced(shell, Reduction(sh_degree=0), EncodeOptions(attribute_psnr=60.0))
    reduction = Reduction(sh_degree=0, distil=True)
    views = views_of(cameras(24))
    distilled = encode_reduced(shell, reduction, EncodeOptions(attribute_psnr=60.0), views=views)
    scene = stored(shell, distilled)
    assert ["means", "covariance", "opacities"] == [record.measure for record in scene.declared_bounds.records]
    assert scene.declared_bounds.refitted
    said = scene.options["reduced"]
    assert ("distilled", 21) == (said["sh"], said["views"])
    judge = Scorer.of_source(shell, views.validation, (0.0, 0.0, 0.0))
    before, after = (judge.psnr(decode(one.data)) for one in (truncated, distilled))
    assert said["check_psnr"] == pytest.approx(after, abs=0.5)
    assert after > before + 1.0


def test_distilled_and_clustered_colours_state_no_error(shell):
    from captures import cameras, views_of

    reduction = Reduction(prune_opacity=0.15, sh_degree=1, distil=True, kmeans=parse_kmeans("64"))
    scene = stored(shell, encode_reduced(shell, reduction, views=views_of(cameras(9))))
    assert ["means", "covariance", "opacities"] == [record.measure for record in scene.declared_bounds.records]
    assert {"kmeans", "check_psnr", "views", "prune_opacity"} <= set(scene.options["reduced"])
    assert 64 >= len(np.unique(np.round(scene.model.opacities, 5)))


@pytest.mark.slow
def test_a_scene_of_one_splat_can_be_distilled(shell):
    from captures import cameras, views_of

    one = shell.select(slice(0, 1))
    result = encode_reduced(one, Reduction(sh_degree=0, distil=True), views=views_of(cameras(9)))
    assert 1 == len(stored(one, result).model)


def test_given_cameras_decide_and_one_is_not_enough(shell):
    from captures import cameras, views_of

    reduction = Reduction(sh_degree=1, distil=True)
    scene = stored(shell, encode_reduced(shell, reduction, views=views_of(cameras(9))))
    assert 8 == scene.options["reduced"]["views"]
    with pytest.raises(InputError, match="no camera to judge"):
        encode_reduced(shell, reduction, views=views_of(cameras(1)))


def test_impossible_reductions_are_refused(make_model):
    model = make_model(20, 1)
    for call, message in (
        (lambda: encode_reduced(model, Reduction(distil=True)), "SH of degree 1: distilling requires a lower"),
        (lambda: encode_reduced(model, Reduction(prune_opacity=0.9999)), "no splat has an opacity above"),
        (lambda: Reduction(prune_opacity=1.5), "the opacity to prune by is 1.5"),
        (lambda: Reduction(sh_degree=4), "sh_degree is 4"),
        (lambda: Reduction(views=1), "1 views"),
        (lambda: Reduction(seed=-1), "seed of views is -1"),
        (lambda: KMeans({}), "of no attribute"),
        (lambda: KMeans({"means": 4}, stages=5), "in 5 stages, expected 1 to 4"),
        (lambda: KMeans({"means": 4}, seed=-1), "seed of k-means is -1"),
    ):
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.slow
def test_pruning_and_clustering_want_no_renderer():
    code = (
        "import sys, json; from csplat_tools.study import parse_kmeans;"
        "print(json.dumps([name for name in ('numba', 'torch', 'matplotlib') if name in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert [] == json.loads(done.stdout)
