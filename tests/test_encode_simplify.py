"""Encoding with simplification: what stands in the file, what it costs, and that it proves what it states."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("numba", reason="simplification wants the extra [render]")

from captures import views_of

from csplat import EncodeOptions, decode, encode, write_ply
from csplat.decoder import decode_scene
from csplat.encoder import Draft, Origin, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.judge import Judge, renderer
from csplat_tools.app import app
from csplat_tools.proof import prove
from csplat_tools.simplify import SimplifyOptions, Target, encode_simplified
from csplat_tools.simplify.order import Order
from csplat_tools.simplify.sizing import first_count, next_count
from csplat_tools.views import BLACK, camera_sequence
from csplat_trainer.pictures import Picture

SMALL = SimplifyOptions(views=16, view_size=(48, 36), steps=4, rounds=2)


@pytest.fixture(scope="module")
def source():
    """A shell of 400 overlapping splats."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((400, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    quats = rng.standard_normal((400, 4))
    return SplatModel(
        means=means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(-2.5, -1.3, (400, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 1.0, 400).astype(np.float32),
        sh0=(np.sin(3.0 * means) + 0.5).astype(np.float32),
        shN=(0.1 * rng.standard_normal((400, 15, 3))).astype(np.float32),
    )


# what files state of themselves


def test_the_file_says_what_it_stands_for(source):
    rows = np.arange(100, 300)
    origin = Origin(len(source), rows, refitted=True)
    result = encode_with_report(source.select(rows), origin=origin, said={"simplified": {"why": "a test"}})
    scene = decode_scene(result.data)
    stated = scene.stated_errors
    assert (400, 200, True) == (stated.source_count, stated.pruned_count, stated.refitted)
    assert ["means", "covariance", "opacities"] == [record.measure for record in stated.records]
    assert {"means", "covariance", "opacities"} == set(result.report.errors)
    assert {"why": "a test"} == result.report.options["simplified"]
    assert set(result.source_index) == set(rows)


def test_the_geometry_of_a_refitted_file_is_proved(source):
    rows = np.arange(100, 300)
    draft = Draft.of(source.select(rows), origin=Origin(len(source), rows))
    result = draft.with_colours(draft.scene.sh0 + 1, draft.scene.shN).coded().write()
    scene = decode_scene(result.data)
    whole = prove(source, scene.model, scene.header, scene.stated_errors, result.source_index)
    assert whole.holds
    assert whole.rms_proved
    assert ["means", "covariance", "opacities"] == [measure.name for measure in whole.measures]
    assert "fitted anew" in whole.notes[-1]
    assert prove(source, scene.model, scene.header, scene.stated_errors).holds
    moved = replace(source, means=source.means + np.float32(0.1))
    assert not prove(moved, scene.model, scene.header, scene.stated_errors, result.source_index).holds
    other = prove(source.select(slice(0, 399)), scene.model, scene.header, scene.stated_errors)
    assert "source of 400 splats" in other.failures[0]


def test_a_file_of_adjusted_shapes_states_its_means_alone(source):
    rows = np.arange(100, 300)
    adjusted = replace(source, scales=source.scales + np.float32(0.1)).select(rows)
    result = encode_with_report(adjusted, origin=Origin(len(source), rows, refitted=True, adjusted=True))
    scene = decode_scene(result.data)
    assert ["means"] == [record.measure for record in scene.stated_errors.records]
    assert prove(source, scene.model, scene.header, scene.stated_errors, result.source_index).holds
    assert prove(source, scene.model, scene.header, scene.stated_errors).holds
    moved = replace(source, means=source.means + np.float32(0.1))
    assert not prove(moved, scene.model, scene.header, scene.stated_errors).holds


# absent bands


def sparse_model(source, share, seed=0):
    """Bands 2 and 3 of some splats are zero."""
    shN = source.shN.copy()
    shN[np.random.default_rng(seed).random(len(source)) < share, 3:] = 0.0
    return replace(source, shN=shN)


@pytest.mark.parametrize("options", [{}, {"tile_splats": 50}, {"profile": "archive"}, {"adaptive": 0.5}])
def test_absent_bands_are_decoded_as_zeros_and_the_others_as_without(source, options):
    model = sparse_model(source, 0.9)
    settings = EncodeOptions(sh_coding="scalar", **options)
    result = encode_with_report(model, settings, importance=np.ones(400))
    decoded = decode(result.data)
    expected = model.shN[result.source_index]
    np.testing.assert_allclose(expected, decoded.shN, atol=0.2)
    absent = ~expected[:, 3:].any(axis=(1, 2))
    assert not decoded.shN[absent, 3:].any()
    assert decode_scene(result.data).header.codebooks


def test_absent_bands_cost_next_to_nothing(source):
    rng = np.random.default_rng(1)
    big = source.select(rng.integers(0, 400, 20_000))
    big = replace(
        big,
        means=rng.standard_normal((20_000, 3)).astype(np.float32),
        shN=(0.1 * rng.standard_normal((20_000, 15, 3))).astype(np.float32),
    )
    sizes = {}
    for share in (0.0, 0.95, 1.0):
        sizes[share] = len(encode(sparse_model(big, share), EncodeOptions(sh_coding="scalar")))
    full = sizes[0.0] - sizes[1.0]
    # A twentieth of the values, and two index streams of at most three tenths of a bit and some.
    assert sizes[0.95] - sizes[1.0] < 0.05 * full + 2 * 20_000 * 0.5 / 8
    assert encode_with_report(big, EncodeOptions(sh_coding="scalar")).report.errors["sh3"][0] < 0.2


def test_scenes_without_absent_bands_have_no_codebook_for_them(source):
    data = encode(source, EncodeOptions(sh_coding="scalar"))
    assert not decode_scene(data).header.codebooks


# the whole


def test_a_share_of_the_splats_is_encoded_with_its_colours_fitted(source):
    file = encode_simplified(source, target=Target(keep=0.6), options=SMALL)
    decoded = decode(file.result.data)
    assert len(decoded) == 240
    assert len(np.unique(file.result.source_index)) == 240
    distances = np.linalg.norm(decoded.means - source.means[file.result.source_index], axis=1)
    assert distances.max() <= file.result.report.errors["means"][0]
    assert file.report["psnr"] > 20.0
    json.dumps(file.report, allow_nan=False)


def test_shapes_are_clustered_by_what_the_views_say_of_them(source):
    alike = replace(source, quats=source.quats[np.arange(400) % 8], scales=source.scales[np.arange(400) % 8])
    encoding = EncodeOptions(shape_codebook_size=64, sh_coding="none")
    file = encode_simplified(alike, target=Target(keep=0.9), encoding=encoding, options=SMALL)
    assert 0 < file.result.report.options["shape_codebook_size"] <= 60
    assert len(decode(file.result.data)) == 360


def test_fitting_to_the_quantised_geometry_mends_it(source):
    """Coarse geometry, fine colours: fitted colours are better than the source's on views that were not used."""
    coarse = EncodeOptions(opacity_levels=8, scale_step=0.3, quat_levels=8, sh0_step=0.005, sh_step=0.005)
    scene = replace(source, shN=source.shN[:, :0])
    options = replace(SMALL, views=160, bands=False, steps=8)
    judge = Judge.of_source(scene, camera_sequence(scene, 60, (64, 48), seed=9), (0, 0, 0))
    own = camera_sequence(scene, 160, (48, 36), seed=1)
    fitted = encode_simplified(scene, views_of(own), target=Target(keep=1.0), encoding=coarse, options=options)
    plain = judge.psnr(decode(encode(scene, coarse)))
    assert judge.psnr(decode(fitted.result.data)) > plain + 0.3


@pytest.mark.parametrize("goal", [30.0, 38.0])
def test_a_file_of_a_target_psnr_is_never_larger_than_without(source, goal):
    cameras = camera_sequence(source, 24, (48, 36), seed=3)
    file = encode_simplified(source, views_of(cameras), target=Target(psnr=goal), options=SMALL)
    assert file.report["psnr"] >= goal
    sizes = [one["size_bytes"] for one in file.report["tried"]]
    assert len(file.result.data) == min(sizes)
    assert file.report["tried"][0]["splats"] == 400  # the whole scene was among them


def test_a_loss_against_photographs_lets_splats_go(source):
    """Photographs that the source misses by 25 dB: what may be lost is measured by renders, what was by photographs."""
    cameras = camera_sequence(source, 160, (48, 36), seed=3)
    rng = np.random.default_rng(1)
    draw = renderer(source, BLACK)
    noisy = [np.clip(draw(c).rgb + 0.06 * rng.standard_normal((c.H, c.W, 3)), 0, 1) for c in cameras]
    pictures = [Picture(c, np.rint(255.0 * p).astype(np.uint8)) for c, p in zip(cameras, noisy, strict=True)]
    views = views_of(cameras, pictures)
    judge = views.photograph_decider()
    file = encode_simplified(source, views, target=Target(max_loss=0.5), options=SMALL)
    assert judge.psnr(source) < 28.0
    assert judge.psnr(decode(file.result.data)) >= judge.psnr(source) - 0.5
    assert file.report["splats"] < 400
    assert len(file.result.data) < file.report["tried"][0]["size_bytes"]


def test_a_psnr_that_no_file_has_is_refused(source):
    views = views_of(camera_sequence(source, 6, (48, 36)))
    with pytest.raises(InputError, match="no file reaches"):
        encode_simplified(source, views, target=Target(psnr=99.0), options=replace(SMALL, steps=1))


def test_bytes_do_not_depend_on_threads(source):
    one, two = (
        encode_simplified(
            source, target=Target(keep=0.5), encoding=EncodeOptions(threads=n), options=replace(SMALL, threads=n)
        )
        for n in (1, 2)
    )
    assert one.result.data == two.result.data


# the command


def invoke(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_command_simplifies_encodes_and_its_file_is_proved(source, tmp_path):
    scene, file, index = tmp_path / "scene.ply", tmp_path / "scene.csplat", tmp_path / "index.npy"
    write_ply(scene, source)
    words = ("encode", scene, file, "--simplify", "--keep", "0.5", "--views", "6", "--source-index", index, "--json")
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["splats"] == 200
    assert invoke("verify", file, "--source", scene, "--source-index", index).exit_code == 0
    assert invoke("verify", file, "--source", scene).exit_code == 0
    assert "200 pruned" in invoke("info", file).stdout


@pytest.mark.parametrize(
    "words",
    [
        ("--simplify",),
        ("--keep", "0.5"),
        ("--simplify", "--keep", "0.5", "--max-loss", "1"),
        ("--simplify", "--keep", "0.5", "--importance", "weights.npy"),
    ],
)
def test_words_that_do_not_go_together_are_a_wrong_command_line(source, tmp_path, words):
    write_ply(tmp_path / "scene.ply", source)
    assert invoke("encode", tmp_path / "scene.ply", tmp_path / "out.csplat", *words).exit_code == 2


# a size


def test_the_best_number_of_splats_balances_removal_and_quantisation():
    order = Order(np.arange(90), np.linspace(0.0, 2.0, 90) ** 3, ())
    # Nothing was removed yet, and quantisation costs all of the error: fewer splats are better.
    assert next_count(order, 100, 90, 30.0, 60.0) < 90
    # All of the error is that of what was removed: more are.
    assert next_count(order, 100, 20, 30.0, 30.0) > 20
    assert first_count(1800, 1000, has_sh=False) == 100
    assert first_count(10**9, 1000, has_sh=True) == 1000


def test_a_size_is_filled_by_what_was_simplified(source):
    file = encode_simplified(source, target=Target(size_bytes=4000), options=SMALL)
    assert 0.9 * 4000 <= len(file.result.data) <= 4000
    assert file.report["splats"] < 400
    assert file.report["psnr"] == max(one["psnr"] for one in file.report["tried"])
    with pytest.raises(InputError, match="no file has 200 bytes"):
        encode_simplified(source, target=Target(size_bytes=200), options=SMALL)
