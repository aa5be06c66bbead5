"""Extreme scenes: read, encoded, decoded, rendered, by commands, too; tools/docs/results/extremes.md has the results.

Every condition goes through all stages once (`chains`). Presets and qualities are crossed for two conditions, and two
go through learning; the others, and the million splats, are in the area `extremes`.
"""

import json
import re

import numpy as np
import pytest
from checked import measure_errors
from command_line import change_views
from extremes import (
    ARRAYS,
    CONDITIONS,
    COPIES,
    COUNT,
    DRAWN,
    FAR,
    NAMES,
    PRESETS,
    TRAINED,
    assert_finite,
    chain_of,
    encoded,
    scene,
    scorer,
    verify,
    write_columns,
    write_scene,
)
from tables import failures
from typer.testing import CliRunner

from csplat import decode, read_ply, write_ply
from csplat.decoder import read_declared_bounds, read_header
from csplat.errors import LimitError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.cli.app import app

pytest.importorskip("numba", reason="requires the extra [render]")


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_views")]
QUALITIES = {None: None, 10.0: 12.0, 120.0: 44.0}  # attribute_psnr, and the least PSNR of renders, dB
QUICK = ("needles", "half the rows NaN")  # crossed with presets and qualities outside the area, too
LONG = pytest.mark.long
EACH = [pytest.param(name, marks=() if name in QUICK else LONG) for name in DRAWN]


@pytest.fixture(scope="module")
def chains(once):
    """Return every condition after all stages."""
    return once("extremes", lambda: {name: chain_of(name) for name in NAMES})


def assert_each(chains, check):
    """Call `check(name, chain)` for each condition; fail with the names of those that fail."""
    assert [] == failures({name: (name, chain) for name, chain in chains.items()}, lambda case: check(*case))


def assert_render_is_finite(result):
    for name in ("rgb", "alpha", "depth"):
        assert np.isfinite(getattr(result, name)).all(), name
    assert 0.0 <= result.alpha.min() <= result.alpha.max() <= 1.0


@pytest.mark.long
def test_reading_repairs_defects_and_strict_reading_refuses_them(chains):
    def check(name, chain):
        repairs = CONDITIONS[name].repairs
        assert repairs == tuple(finding.id for finding in chain.findings if finding.kind == "repair")
        assert repairs == chain.linted
        assert (repairs[0] in chain.refusal) if repairs else (chain.refusal == "")
        count = COUNT - CONDITIONS[name].dropped
        assert {"one splat": 1, "a million identical": COPIES}.get(name, count) == len(chain.source)
        huge = [finding.count for finding in chain.findings if finding.id == "huge-values"]
        assert ([8] if name == "exploded" else []) == huge

    assert_each(chains, check)


def test_decoded_scenes_are_finite_and_within_the_declared_bounds(chains):
    def check(name, chain):
        assert ((), True) == (chain.verification.failures, chain.verification.rms_verified)
        assert list(range(len(chain.source))) == sorted(chain.result.source_index.tolist())
        assert chain.source.origin == chain.decoded.origin
        if name in DRAWN:  # without a source index, too
            header, bounds = read_header(chain.result.data), read_declared_bounds(chain.result.data)
            assert () == verify_bounds(Source.of(chain.source), chain.decoded, header, bounds).failures
        for result in chain.renders:
            assert_render_is_finite(result)

    assert_each(chains, check)


def test_decoded_scenes_survive_writing_and_reading_a_ply(chains, tmp_path):
    def check(_, chain):
        decoded = chain.decoded
        write_ply(tmp_path / "back.ply", decoded)
        again = read_ply(tmp_path / "back.ply", strict=True)
        assert decoded.origin == again.origin
        for array in ("means", "scales", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(decoded, array), getattr(again, array), array)
        np.testing.assert_allclose(decoded.quats, again.quats, atol=1e-6)
        np.testing.assert_allclose(decoded.opacities, again.opacities, atol=1e-6)

    assert_each(chains, check)


def test_a_little_learning_keeps_splats_finite_and_lowers_the_loss(chains):
    def check(name, chain):
        if name not in TRAINED:
            return
        learnt = chain.learnt
        assert len(chain.source) // 2 == len(learnt.half)
        assert_finite(learnt.half)
        assert COUNT == len(learnt.trained)
        assert_finite(learnt.trained)
        assert np.mean(learnt.losses[-10:]) < 0.98 * np.mean(learnt.losses[:10])
        if name == "exploded":
            assert "colours are too large for tuning" in learnt.tuned
        else:
            assert_finite(learnt.tuned)

    assert_each(chains, check)


def test_identical_splats_decode_identically(chains):
    chain = chains["a million identical"]
    assert len(chain.result.data) < 3_000
    for array in ARRAYS:
        values = getattr(chain.decoded, array)
        assert (values == values[0]).all(), array
    assert (0.0, 0.0) == measure_errors(chain.source, chain.decoded, np.arange(COPIES))["means"]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", [*EACH, pytest.param("a million identical", marks=LONG)])
def test_each_preset_and_quality_is_within_the_declared_bounds(name, preset):
    source = scene(name)[0]
    for quality, least in QUALITIES.items() if name in DRAWN else ((None, None),):
        result = encoded(name, preset, quality)
        decoded = decode(result.data)
        verification = verify(source, result, decoded)
        assert ((), True) == (verification.failures, verification.rms_verified)
        assert list(range(len(source))) == sorted(result.source_index.tolist())
        assert source.origin == decoded.origin
        if least and preset == "balanced" and name != "exploded":  # steps move the edges of infinitely bright splats
            assert scorer(name, (160, 120)).psnr(decoded) >= least


def test_an_origin_preserves_precision_ten_kilometres_away():
    def lost(name):
        model = scene(name)[0]
        return np.abs(model.means.astype(np.float64) + model.origin - true).max()

    true = scene("10 km away, origin")[0].means.astype(np.float64) + FAR
    assert (FAR, FAR, FAR) == scene("10 km away, origin")[0].origin
    assert 2e-4 < lost("10 km away") <= 2.0**-11  # half of float32's resolution there
    assert lost("10 km away, doubles") <= 2.0**-23
    # Declared errors do not include what was lost before encoding.
    errors = [encoded(name, "balanced", 120.0).report.errors["means"][0] for name in NAMES[:2]]
    assert (0.0, True) == (errors[0], 0.0 < errors[1] < 1e-4)


def test_an_origin_is_derived_from_coordinates_in_doubles(tmp_path):
    model = scene("10 km away, doubles")[0]
    assert all(abs(value - FAR) < 1.0 for value in model.origin)
    decoded = decode(encoded("10 km away, doubles", "balanced").data)
    write_ply(tmp_path / "absolute.ply", decoded, absolute=True)
    again = read_ply(tmp_path / "absolute.ply")
    assert decoded.origin == again.origin
    np.testing.assert_allclose(decoded.means, again.means, rtol=0, atol=1e-6)


def test_renders_lose_little_ten_kilometres_away():
    """Renders with float32 coordinates keep 45 dB or more of those with an origin, from the same relative camera."""
    K = intrinsics(160, 120, 60.0)
    near, far = (
        render(scene(name)[0], look_at(np.array([0.0, -1.0, 3.0]) + at, np.full(3, at), (0, -1, 0), K, 160, 120)).rgb
        for name, at in (("10 km away, origin", 0.0), ("10 km away", FAR))
    )
    assert 45.0 <= -10.0 * np.log10(np.square(near - far).mean()) < 80.0


@LONG
def test_a_million_identical_splats_are_rendered_in_one_tile_and_refused_in_many():
    source = scene("a million identical")[0]
    K = intrinsics(48, 36, 60.0)
    # Far enough away for one tile to contain them all; the colour is that of the pile.
    eye = source.means[0] + np.array([0.0, 0.0, 12.0])
    camera = look_at(eye, source.means[0], (0, -1, 0), K, 48, 36)
    renders = [render(model, camera) for model in (source, decode(encoded("a million identical", "fast").data))]
    for result in renders:
        assert_render_is_finite(result)
        assert result.alpha.max() > 0.999
    assert np.square(np.clip(renders[0].rgb, 0, 1) - np.clip(renders[1].rgb, 0, 1)).mean() < 1e-3
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(source, virtual_cameras(source, 1)[0])


def test_transparent_scenes_stay_transparent():
    result = encoded("all transparent", "small", 120.0)
    model = decode(result.data)
    np.testing.assert_array_equal(model.opacities == 0.0, result.source_index % 2 == 1)
    assert model.opacities.max() < 1 / 255
    result = render(model, virtual_cameras(model, 1, 64, 48)[0], background=(0.25, 0.5, 0.75))
    np.testing.assert_array_equal(result.rgb, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (48, 64, 3)))


@pytest.mark.parametrize("preset", PRESETS)
def test_exploded_splats_do_not_affect_others(preset):
    """Values outside every lattice get their own tiles; errors of the other splats stay as they are without them."""
    source, result = scene("exploded")[0], encoded("exploded", preset)
    assert any(note.startswith("sh0: huge values coarsen 1 of") for note in result.report.notes)
    decoded = decode(result.data)
    rest = (result.source_index < 40) | (result.source_index >= 48)
    assert COUNT - 8 == np.count_nonzero(rest)
    errors = measure_errors(source, decoded.select(rest), result.source_index[rest])
    steps = result.report.options
    assert errors["sh0"][0] <= 2.0 * steps["sh0_step"]
    assert errors["sh1"][0] <= 2.0 * steps["sh_step"]
    scales = np.sort(decoded.scales[rest], axis=1) - np.sort(source.scales[result.source_index[rest]], axis=1)
    assert np.abs(scales).max() <= 0.51 * steps["scale_step"]


def run(*words, status=0):
    """Run a command. Warnings of NumPy are errors, and exceptions other than ours are raised."""
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert status == done.exit_code, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    return done


def refused(*words):
    """Run a command that fails with one line besides remarks and progress; return that line."""
    (error,) = [line for line in run(*words, status=1).stderr.splitlines() if line.startswith("error: ")]
    return error


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if "NaN" in name else LONG) for name in DRAWN])
def test_the_whole_chain(name, tmp_path):
    ply, file, back = write_scene(tmp_path, name), tmp_path / "scene.csplat", tmp_path / "back.ply"
    condition = CONDITIONS[name]
    done = run("encode", ply, file, "--source-index", tmp_path / "index.npy")
    assert condition.repairs == tuple(re.findall(r"^repair: ([a-z-]+):", done.stderr, re.MULTILINE))
    assert ("huge values coarsen" in done.stderr) == (name == "exploded")

    done = run("verify", file, "--source", ply, "--source-index", tmp_path / "index.npy", "--json")
    assert json.loads(done.stdout)["proof"]["rms_and_counts_proved"]

    run("decode", file, back)
    assert len(condition.make()["means"]) - condition.dropped == len(read_ply(back, strict=True))
    assert json.loads(run("info", file, "--json").stdout)["size_bytes"] == file.stat().st_size

    run("render", file, "--orbit", 2, "--size", "64x48", tmp_path / "pictures", "--depth")
    assert ["0000.depth.npy", "0000.png", "0001.depth.npy", "0001.png"] == names_in(tmp_path / "pictures")
    assert np.isfinite(np.load(tmp_path / "pictures" / "0000.depth.npy")).all()

    with pytest.MonkeyPatch.context() as patch:
        change_views(patch, 3, (40, 30))
        done = run("simplify", ply, tmp_path / "half.ply", "--keep", 0.5, "--effort", 1, "--json")
    assert json.loads(done.stdout)["splats"] == len(read_ply(tmp_path / "half.ply", strict=True))


@LONG
def test_a_million_identical_splats_are_encoded_but_not_rendered(tmp_path):
    ply, file = write_scene(tmp_path, "a million identical"), tmp_path / "scene.csplat"
    run("encode", ply, file, "--preset", "fast")
    assert file.stat().st_size < 6_000
    run("verify", file, "--source", ply)
    assert "MAX_INTERSECTIONS" in refused("render", file, "--orbit", 1, tmp_path / "pictures")
    run("decode", file, tmp_path / "back.ply", "--max-splats", 999_999, status=1)
    assert ["scene.csplat", "scene.ply"] == names_in(tmp_path)


def test_a_splat_with_huge_and_small_scales_has_declared_bounds(tmp_path):
    """A lattice that contains a log scale of -3e38 rounds one of -1000 to 0."""
    columns = CONDITIONS["exploded"].make()
    columns["scales"][50] = [-3e38, -1000.0, -1000.0]
    ply, file = write_columns(tmp_path / "scene.ply", columns), tmp_path / "scene.csplat"
    assert "huge values coarsen" in run("encode", ply, file).stderr
    run("verify", file, "--source", ply)


def test_a_scene_without_splats_gives_an_empty_file_and_one_of_nan_is_refused(tmp_path):
    columns = CONDITIONS["needles"].make()
    ply, file = tmp_path / "scene.ply", tmp_path / "scene.csplat"
    write_columns(ply, {name: array[:0] for name, array in columns.items()})
    run("encode", ply, file)
    run("verify", file, "--source", ply)
    assert "without splats cannot be simplified" in refused("simplify", ply, tmp_path / "half.ply", "--keep", 0.5)
    run("render", file, "--orbit", 1, "--size", "32x24", tmp_path / "pictures")
    columns["means"][:] = np.nan
    write_columns(ply, columns)
    assert "300 splats with NaN or infinity: none is left" in refused("encode", ply, tmp_path / "none.csplat")
    assert ["pictures", "scene.csplat", "scene.ply"] == names_in(tmp_path)


def test_quiet_encoding_prints_only_repairs(tmp_path):
    done = run("encode", write_scene(tmp_path, "half the rows NaN"), tmp_path / "scene.csplat", "-q")
    assert "" == done.stdout
    assert "repair: nonfinite-rows: 150 splats with NaN or infinity: dropped" == done.stderr.strip()
