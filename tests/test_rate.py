"""Rate control: targets of size, PSNR and largest errors, met by the file itself."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from csplat import EncodeOptions, decode, read_ply, write_ply
from csplat.encoder import encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.app import app
from csplat_tools.rate.bounds import meet_bounds
from csplat_tools.rate.search import Window, meet
from csplat_tools.rate.targets import RateTarget, parse_max_error, parse_size_bytes

pytest.importorskip("numba", reason="targets of size and PSNR want the extra [render]")

import extremes
from captures import cameras, shell

from csplat.encoder.measure import measure_errors
from csplat_render.cameras import intrinsics, look_at
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame
from csplat_tools.rate.control import encode_to_target
from csplat_tools.rate.trials import spread_of
from csplat_tools.views import comparison_cameras


@pytest.fixture(scope="module")
def scene():
    return shell(8)


@pytest.fixture(scope="module")
def crowded(scene):
    """The same, and twice as many splats that hardly anybody sees."""
    rng = np.random.default_rng(1)
    faint = {
        "means": (0.5 * rng.standard_normal((600, 3))).astype(np.float32),
        "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (600, 1)),
        "scales": np.full((600, 3), -4.0, np.float32),
        "opacities": np.full(600, 0.02, np.float32),
        "sh0": np.zeros((600, 3), np.float32),
        "shN": np.zeros((600, 8, 3), np.float32),
    }
    return SplatModel(**{name: np.concatenate([getattr(scene, name), array]) for name, array in faint.items()})


# what is asked


@pytest.mark.parametrize(
    ("text", "expected"),
    [("5MB", 5_000_000), ("1.5 MiB", 1_572_864), ("300kB", 300_000), ("300KiB", 307_200), ("123456", 123_456)],
)
def test_sizes_are_read_as_they_are_written(text, expected):
    assert parse_size_bytes(text) == expected


@pytest.mark.parametrize("text", ["", "MB", "5 apples", "-3MB", "0", "1e30GB", "5 M B"])
def test_other_texts_are_no_sizes(text):
    with pytest.raises(InputError, match="a size is"):
        parse_size_bytes(text)


def test_bounds_are_read_by_measure():
    assert parse_max_error("means=0.001,opacities=1e-2", None) == {"means": 0.001, "opacities": 0.01}


def test_a_length_with_a_unit_wants_a_scene_that_has_one():
    with pytest.raises(InputError, match="--unit-metres"):
        parse_max_error("means=1mm", None)
    assert parse_max_error("means=1mm", 0.5) == {"means": 0.002}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("means", "bounds no error"),
        ("means=", "bounds no error"),
        ("weight=1", "no measure"),
        ("means=0", "above 0"),
        ("means=1,means=2", "twice"),
        ("sh0=1mm", "no length"),
        ("means=1parsec", "wanted one of"),
    ],
)
def test_other_bounds_are_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_max_error(text, 1.0)


def test_a_size_and_a_psnr_are_too_many():
    with pytest.raises(InputError, match="one of them"):
        RateTarget(1000, 40.0)


# looking for a number


def test_meet_ends_inside_the_window():
    points = meet(lambda q: q * q / 50, Window(31.9, 32.1, 32.0), start=20.0, slope=1.0, bounds=(0, 100), tries=9)
    assert 31.9 <= points[-1][1] <= 32.1
    assert points[-1][0] == pytest.approx(40.0, abs=0.1)


def test_meet_stops_at_a_bound():
    points = meet(lambda q: q, Window(200, 201, 200), start=50.0, slope=1.0, bounds=(0, 100), tries=9)
    assert [place for place, _ in points] == [50.0, 100.0]


def test_a_plateau_is_crossed():
    def value(place):
        return 34.0 if place < 55.0 else place - 21.0

    points = meet(value, Window(38.0, 38.25, 38.1), start=42.0, slope=1.0, bounds=(24, 110), tries=9)
    assert 38.0 <= points[-1][1] <= 38.25


def test_meet_gives_up_where_values_grow_no_more():
    points = meet(lambda q: min(q, 40.0), Window(50, 51, 50.5), start=39.0, slope=1.0, bounds=(0, 100), tries=9)
    assert len(points) < 6


def test_spread_is_that_of_the_views():
    assert spread_of(np.full(8, 1e-4)) == 0.0
    assert spread_of(np.array([1e-4, 4e-4])) == pytest.approx(10 * math.log10(4) / 2)
    assert math.isnan(spread_of(np.array([1e-4])))


# largest errors


@pytest.mark.parametrize(
    "bounds",
    [{"means": 1e-4}, {"opacities": 0.004, "covariance": 0.02}, {"sh0": 0.01}, {"sh1": 0.02, "sh2": 0.05}],
)
def test_no_splat_errs_by_more_than_is_allowed(scene, bounds):
    bounded = meet_bounds(scene, EncodeOptions(), bounds)
    decoded = decode(bounded.result.data)
    proof = measure_errors(scene, decoded, bounded.result.source_index)
    for name, bound in bounds.items():
        assert 0.3 * bound < proof[name][0] <= bound
        assert bounded.result.report.errors[name][0] <= bound


def test_outliers_keep_to_a_bound_of_the_means(scene):
    away = (scene.means[:20] * 3000.0).astype(np.float32)
    far = replace(scene, means=np.concatenate([away, scene.means[20:]]))
    coarse = encode_with_report(far, EncodeOptions(position_step=1e-4)).report.errors["means"][0]
    bounded = meet_bounds(far, EncodeOptions(), {"means": 1e-4}).result
    assert bounded.report.errors["means"][0] <= 1e-4 < coarse
    assert any("tiles" in note for note in meet_bounds(far, EncodeOptions(), {"means": 1e-7}).result.report.notes)


def test_a_bound_that_no_lattice_keeps_is_refused(scene):
    with pytest.raises(InputError, match="no lattice keeps the error of opacities within 1e-09"):
        meet_bounds(scene, EncodeOptions(), {"opacities": 1e-9})


def test_a_knob_and_its_bound_contradict_each_other(scene):
    with pytest.raises(InputError, match="position_step is given"):
        meet_bounds(scene, EncodeOptions(position_step=0.1), {"means": 0.1})
    for fixed in (EncodeOptions(sh_coding="none"), EncodeOptions(adaptive=0.5)):
        with pytest.raises(InputError, match="error"):
            meet_bounds(scene, fixed, {"sh1": 0.1})
    with pytest.raises(InputError, match="codebook bounds no error"):
        meet_bounds(scene, EncodeOptions(sh_coding="codebook"), {"sh1": 0.1})


# sizes and PSNRs


def test_a_psnr_is_reached_and_hardly_exceeded(sample_path):
    source = read_ply(sample_path)
    found = encode_to_target(source, RateTarget(psnr=38.0), prune=False)
    psnr = Judge.of_source(source, comparison_cameras(source)).psnr(decode(found.result.data))
    assert 38.0 <= psnr <= 38.3
    assert found.report["psnr"] == pytest.approx(psnr, abs=1e-4)
    assert found.report["size_bytes"] == len(found.result.data)


@pytest.mark.parametrize("goal", [4500, 7000])
def test_a_size_is_filled_and_not_exceeded(scene, goal):
    found = encode_to_target(scene, RateTarget(size_bytes=goal), cameras=cameras(12))
    assert 0.97 * goal <= len(found.result.data) <= goal


def test_more_bytes_are_better_pictures(scene):
    small, large = (
        encode_to_target(scene, RateTarget(size_bytes=size), prune=False).report["psnr"] for size in (3000, 6000)
    )
    assert large > small + 3.0


def test_splats_that_nobody_needs_are_left_out(crowded):
    kept = encode_to_target(crowded, RateTarget(psnr=36.0), prune=False)
    pruned = encode_to_target(crowded, RateTarget(psnr=36.0), views=24)
    assert len(decode(kept.result.data)) == 900
    assert len(decode(pruned.result.data)) < 600
    assert len(pruned.result.data) < 0.8 * len(kept.result.data)
    assert pruned.report["psnr"] >= 36.0
    proof = measure_errors(crowded, decode(pruned.result.data), pruned.result.source_index)
    for name, (largest, _) in pruned.result.report.errors.items():
        assert proof[name][0] <= largest


def test_a_size_that_starves_all_splats_is_met_by_fewer(crowded):
    found = encode_to_target(crowded, RateTarget(size_bytes=2200), views=24)
    assert len(found.result.data) <= 2200
    assert found.report["splats"] < 900
    without = encode_to_target(crowded, RateTarget(size_bytes=2200), EncodeOptions(sh_degree=0), views=24)
    assert found.report["psnr"] > without.report["psnr"] - 0.2


def test_cameras_that_see_nothing_are_refused(scene):
    K = intrinsics(48, 40, 60.0)
    away = look_at((40.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0, 0, 1), K, 48, 40)
    with pytest.raises(InputError, match="cameras of this scene"):
        encode_to_target(scene, RateTarget(psnr=30.0), cameras=[away])


def test_splats_that_have_to_stay_are_not_asked_to_go(scene):
    with pytest.raises(InputError, match="no splat can be left out by the preset fast"):
        encode_to_target(scene, RateTarget(psnr=30.0), EncodeOptions(preset="fast"), prune=True)
    with pytest.raises(InputError, match="where errors are bounded"):
        encode_to_target(scene, RateTarget(psnr=30.0, max_error={"means": 0.01}), prune=True)


def test_a_psnr_below_all_files_is_exceeded_and_said_to_be(scene):
    report = encode_to_target(scene, RateTarget(psnr=2.0), prune=False).report
    assert report["psnr"] > 2.3
    assert "no smaller file of those tried reaches the target" in report["why"]


def test_a_size_below_all_files_is_refused(scene):
    with pytest.raises(InputError, match="no file with all splats has 300 bytes"):
        encode_to_target(scene, RateTarget(size_bytes=300), prune=False)
    with pytest.raises(InputError, match="no file has 300 bytes"):
        encode_to_target(scene, RateTarget(size_bytes=300), views=24)


def test_a_psnr_beyond_float32_is_refused(scene):
    with pytest.raises(InputError, match="no file reaches 98"):
        encode_to_target(scene, RateTarget(psnr=98.9), prune=False)


def test_the_preset_fast_tries_no_codebook_and_keeps_all(crowded):
    found = encode_to_target(crowded, RateTarget(psnr=36.0), EncodeOptions(preset="fast"))
    assert found.report["splats"] == 900
    assert {one["sh_coding"] for one in found.report["tried"]} <= {"scalar", "none"}


def test_what_the_caller_fixed_is_not_chosen(scene):
    fixed = EncodeOptions(sh_degree=1, sh_coding="scalar", sh0_step=0.5)
    found = encode_to_target(scene, RateTarget(psnr=24.0), fixed, prune=False)
    assert {(one["sh_degree"], one["sh_coding"]) for one in found.report["tried"]} == {(1, "scalar")}
    assert found.result.report.options["sh0_step"] == 0.5


def test_bounds_hold_beside_a_psnr(scene):
    found = encode_to_target(scene, RateTarget(psnr=30.0, max_error={"means": 1e-3}))
    assert found.result.report.errors["means"][0] <= 1e-3
    assert 30.0 <= found.report["psnr"] <= 30.6  # files of so few splats jump


def test_a_scene_without_splats_has_nothing_to_choose(scene):
    with pytest.raises(InputError, match="without splats"):
        encode_to_target(scene.select(np.zeros(0, np.int64)), RateTarget(psnr=30.0))


def test_of_surroundings_all_splats_stay_unless_asked(crowded):
    surroundings = replace(
        crowded, means=(crowded.means * np.where(np.arange(900) % 3, 1.0, 9.0)[:, None]).astype("f4")
    )
    assert scene_frame(surroundings).kind == "surrounding"
    report = encode_to_target(surroundings, RateTarget(psnr=30.0), views=24).report
    assert (report["splats"], report["removal_views"], report["sensitivity_views"]) == (900, 0, 0)
    assert "all splats stay" in report["why"][-1]
    assert encode_to_target(surroundings, RateTarget(psnr=30.0), views=24, prune=True).report["removal_views"] > 0


@pytest.mark.extremes
@pytest.mark.parametrize("name", ["one splat", "exploded", "all transparent", "float32 limits"])
def test_extreme_scenes_meet_a_psnr(name):
    source = extremes.scene(name)[0]
    found = encode_to_target(source, RateTarget(psnr=17.0), views=24)
    assert Judge.of_source(source, comparison_cameras(source)).psnr(decode(found.result.data)) >= 17.0
    assert len(decode(found.result.data)) >= 1


def test_the_same_target_gives_the_same_bytes(scene):
    one, two = (encode_to_target(scene, RateTarget(size_bytes=5000), views=24).result.data for _ in range(2))
    assert one == two


def test_the_report_says_what_why_and_how_sure(crowded):
    report = encode_to_target(crowded, RateTarget(psnr=36.0), views=24).report
    assert report["goal"] == {"psnr": 36.0}
    assert report["encodes"] == len(report["tried"])
    assert report["views"] == 8
    assert report["worst_psnr"] <= report["psnr"]
    assert "8 virtual views" in report["sure"]
    assert any("left out" in line for line in report["why"])
    chosen = [one for one in report["tried"] if one["splats"] == report["splats"]]
    others = next((line for line in report["why"] if "expected to take more" in line), "")
    assert others.count("codebook of") <= len({tuple(one["codebook_sizes"]) for one in chosen})
    json.dumps(report)


# the command


@pytest.fixture
def ply(tmp_path, scene):
    write_ply(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


def run(*arguments):
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_the_command_meets_a_size_and_says_why(tmp_path, ply):
    out = tmp_path / "scene.csplat"
    done = run("encode", ply, out, "--target-size", "5kB", "--views", "24")
    assert done.exit_code == 0, done.output
    assert 4850 <= out.stat().st_size <= 5000
    assert "target: 5.0 kB" in done.stderr
    assert "chosen: SH degree" in done.stderr
    assert "measured on the file itself" in done.stderr


def test_the_command_reports_a_target_as_json(tmp_path, ply):
    done = run("encode", ply, tmp_path / "scene.csplat", "--target-psnr", "34", "--keep-all", "--json")
    report = json.loads(done.stdout)
    assert 34.0 <= report["target"]["psnr"] <= 34.6  # files of so few splats jump
    assert report["target"]["size_bytes"] == report["size_bytes"]


def test_the_command_keeps_to_largest_errors(tmp_path, ply):
    out, index = tmp_path / "scene.csplat", tmp_path / "index.npy"
    arguments = ["encode", ply, out, "--max-error", "means=2mm,sh0=0.01", "--unit-metres", "0.5", "--json"]
    report = json.loads(run(*arguments, "--source-index", index).stdout)
    assert report["stated_errors"]["means"]["max"] <= 0.004
    assert report["stated_errors"]["sh0"]["max"] <= 0.01
    assert run("verify", out, "--source", ply, "--source-index", index).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--target-size", "5kB", "--target-psnr", "30"], 2, "one of them"),
        (["--target-size", "many"], 2, "a size is"),
        (["--target-psnr", "120"], 2, "at most 99"),
        (["--max-error", "means=1mm"], 1, "--unit-metres"),
        (["--target-size", "5kB", "--attribute-psnr", "40"], 2, "--attribute-psnr is what a target chooses"),
        (["--views", "9"], 2, "--views says nothing"),
        (["--grades", "3"], 2, "--grades says nothing"),
        (["--grades", "9", "--target-size", "5kB"], 2, "grades is 9"),
        (["--keep-all"], 2, "say nothing without a target"),
        (["--simplify", "--max-error", "means=1"], 2, "no bounds"),
        (["--cameras", "c.json"], 2, "without a target"),
        (["--max-error", "means=1", "--data", "d"], 2, "nothing is rendered"),
        (["--target-size", "10"], 1, "no file"),
        (["--target-psnr", "30", "--kmeans", "16"], 2, "those choose"),
        (["--keep", "0.5"], 2, "without --simplify"),
        (["--residual-stages", "2"], 2, "without --kmeans"),
        (["--distil-sh"], 2, "wants --sh-degree"),
    ],
)
def test_the_command_refuses_what_says_nothing(tmp_path, ply, arguments, status, message):
    out = tmp_path / "scene.csplat"
    done = run("encode", ply, out, *arguments)
    assert done.exit_code == status
    assert message in " ".join(done.stderr.replace("│", " ").split())
    assert not out.exists()


# grades


@pytest.fixture(scope="module")
def unequal():
    """An object of 9,000 splats, most of them small."""
    rng = np.random.default_rng(3)
    means = rng.standard_normal((9000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return SplatModel(
        means=means.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (9000, 1)),
        scales=np.repeat(rng.normal(-4.0, 0.8, (9000, 1)), 3, axis=1).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, 9000).astype(np.float32),
        sh0=(np.sin(3.0 * means) + 0.5).astype(np.float32),
        shN=np.zeros((9000, 0, 3), np.float32),
    )


def test_splats_are_graded_where_that_makes_files_smaller(unequal):
    def reached(**knobs):
        target, views = RateTarget(psnr=38.0), cameras(41)
        return encode_to_target(unequal, target, EncodeOptions(**knobs), cameras=views, prune=False).report

    graded, even, fast = reached(), reached(grades=1), reached(preset="fast")
    assert graded["chosen"]["grades"] > 1
    assert graded["sensitivity_views"] == 40
    assert any("graded" in line or "grades" in line for line in graded["why"])
    assert graded["size_bytes"] < 0.97 * even["size_bytes"]
    for report in (even, fast):
        assert (report["chosen"]["grades"], report["sensitivity_views"]) == (1, 0)


def test_an_importance_that_is_given_stays(unequal):
    weights = np.linspace(1.0, 2.0, len(unequal))
    found = encode_to_target(
        unequal, RateTarget(psnr=34.0), cameras=cameras(41), prune=False, importance=weights
    ).report
    assert (found["chosen"]["grades"] > 1, found["sensitivity_views"]) == (True, 40)


def test_curvatures_that_are_given_are_compared_with_none_inside_of_surroundings(unequal):
    from csplat_tools.importances import measured_importance

    far = np.where(np.arange(len(unequal)) % 3, 1.0, 9.0)[:, None]
    surroundings = replace(unequal, means=(unequal.means * far).astype(np.float32))
    assert scene_frame(surroundings).kind == "surrounding"
    given = measured_importance(surroundings, cameras(12), (0.0, 0.0, 0.0), threads=None)
    report = encode_to_target(surroundings, RateTarget(psnr=32.0), importance=given).report
    tried = {trial["grades"] for trial in report["tried"]}
    assert min(tried) == 1 < max(tried)
    assert report["sensitivity_views"] == 0
    alone = replace(given, curvatures=None)
    assert encode_to_target(surroundings, RateTarget(psnr=32.0), importance=alone).report["chosen"]["grades"] == 1


def test_small_scenes_without_sh_are_not_measured(scene):
    bare = replace(scene, shN=scene.shN[:, :0])
    report = encode_to_target(bare, RateTarget(psnr=30.0), prune=False).report
    assert report["sensitivity_views"] == 0
    assert len({trial["size_bytes"] for trial in report["tried"]}) == len(report["tried"])
