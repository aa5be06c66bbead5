"""`csplat_bench.distortion`: what curves say between points, which point is next, and its tables."""

import json
import math
from dataclasses import asdict
from types import SimpleNamespace

import pytest

pytest.importorskip("numba", reason="the benchmark renders: pip install 'csplat[render]'")
pytest.importorskip("matplotlib", reason="the benchmark plots: pip install 'csplat[render]'")

from csplat.ply import read_ply, write_ply
from csplat_bench.common import scenes
from csplat_bench.common.command import run as command
from csplat_bench.common.curves import Point, Rate, bracket, front, psnr_at, rate_at
from csplat_bench.common.kept import Kept
from csplat_bench.distortion import __main__ as distortion
from csplat_bench.distortion import ablation
from csplat_bench.distortion import plot as distortion_plot
from csplat_bench.distortion import tables as distortion_tables
from csplat_bench.distortion.known import Measured
from csplat_tools.optimise import splat_refit, subsets, target_search
from csplat_tools.optimise.search_report import Optimised, SearchReport

pytestmark = pytest.mark.area(name="benchmarks")

SCALAR = (Point(38.0, 1000), Point(42.0, 4000))
CODEBOOK = (Point(39.0, 1500), Point(41.0, 6000))


def test_interpolates_the_logarithm_of_the_size():
    assert Rate(pytest.approx(2000.0), "scalar") == rate_at({"scalar": SCALAR}, 40.0)


def test_takes_the_smallest_of_the_series_at_each_psnr():
    series = {"scalar": SCALAR, "codebook": CODEBOOK}
    assert "scalar" == rate_at(series, 40.0).how
    cheaper = {**series, "codebook": (Point(39.0, 900), Point(41.0, 1600))}
    assert Rate(pytest.approx(1200.0), "codebook") == rate_at(cheaper, 40.0)


def test_does_not_mix_series():
    """A line from a point of one series to one of another is no file's."""
    assert Rate(4000, "b", 42.0) == rate_at({"a": [Point(38.0, 1000)], "b": [Point(42.0, 4000)]}, 40.0)


def test_takes_a_better_and_smaller_file_as_it_is():
    assert Rate(1800, "codebook", 43.0) == rate_at({"scalar": SCALAR, "codebook": [Point(43.0, 1800)]}, 40.0)


def test_extrapolates_nothing():
    assert rate_at({"scalar": SCALAR}, 42.1) is None
    assert rate_at({}, 40.0) is None
    assert Rate(1000, "scalar", 38.0) == rate_at({"scalar": SCALAR}, 30.0)


def test_trusts_no_line_across_a_wide_gap():
    assert Rate(9000, "a", 50.0) == rate_at({"a": [Point(38.0, 1000), Point(50.0, 9000)]}, 40.0)


def test_a_point_at_the_goal_needs_no_neighbours():
    assert 1000 == rate_at({"scalar": SCALAR}, 38.0).size_bytes


def test_the_front_leaves_out_what_is_beaten():
    series = {"a": [Point(38.0, 1000), Point(40.0, 3000)], "b": [Point(39.0, 900), Point(39.5, 3000)]}
    assert [Point(39.0, 900), Point(40.0, 3000)] == front(series)


def test_psnr_at_a_size_is_the_inverse_of_the_front():
    assert 40.0 == pytest.approx(psnr_at({"scalar": SCALAR}, 2000))
    assert psnr_at({"scalar": SCALAR}, 999) is None
    assert 42.0 == psnr_at({"scalar": SCALAR}, 10**6)
    assert psnr_at({}, 1000) is None


class Encoder:
    """A quality costs `loss` dB; every dB above a ceiling is lost. Counts."""

    def __init__(self, loss, ceiling=99.0):
        self.loss, self.ceiling, self.qualities = loss, ceiling, []

    def __call__(self, quality):
        self.qualities.append(quality)
        return Point(min(0.9 * quality - self.loss, self.ceiling), round(100 * math.exp(0.08 * quality)), quality)


@pytest.mark.parametrize("loss", [-3.0, 0.0, 9.0])
def test_encloses_a_goal_with_few_measurements(loss):
    encoder = Encoder(loss)
    points = bracket([], 45.0, encoder, start=50.0, limits=(20.0, 110.0))
    assert len(encoder.qualities) == len(points) <= 4
    assert any(43.0 <= one.psnr <= 45.0 for one in points)
    assert any(45.0 <= one.psnr <= 47.0 for one in points)


def test_measures_nothing_where_the_goal_is_enclosed():
    encoder = Encoder(0.0)
    known = [Point(44.0, 1000, 48.9), Point(46.0, 1200, 51.1)]
    assert [] == bracket(known, 45.0, encoder, start=50.0, limits=(20.0, 110.0))


def test_gives_up_at_the_end_of_the_qualities():
    encoder = Encoder(0.0, ceiling=40.0)
    bracket([], 45.0, encoder, start=50.0, limits=(20.0, 60.0))
    assert 60.0 == max(encoder.qualities)
    assert len(encoder.qualities) <= 8
    assert len(set(encoder.qualities)) == len(encoder.qualities)


def test_gives_up_a_series_that_is_not_going_to_be_the_smallest():
    encoder = Encoder(0.0)
    known = [Point(40.0, 1000, 44.4), Point(42.0, 1200, 46.7)]  # 1,577 bytes at 45 dB, on a straight line
    assert [] == bracket(known, 45.0, encoder, start=50.0, limits=(20.0, 110.0), ceiling=1570.0)
    assert bracket(known, 45.0, encoder, start=50.0, limits=(20.0, 110.0), ceiling=1600.0)


def test_gives_up_a_first_point_only_where_the_goal_is_out_of_reach():
    encoder = Encoder(0.0)
    assert [] == bracket([Point(44.0, 1000, 49.0)], 45.0, encoder, start=50.0, limits=(20.0, 110.0), ceiling=1010.0)
    assert bracket([Point(44.0, 1000, 49.0)], 45.0, encoder, start=50.0, limits=(20.0, 110.0), ceiling=1040.0)


def file_of(size_bytes):
    """A simplified file of 40 dB, as it is kept."""
    chosen = {"psnr": 40.0, "size_bytes": size_bytes, "splats": 60, "sh_coding": "scalar"}
    return {"goal": 40.0, **chosen, "encodes": 7, "seconds": 5.0}


def results():
    plain = {"balanced, codebook": [asdict(Point(38.0, 1000)), asdict(Point(42.0, 4000))]}
    peers = {"SPZ": asdict(Point(40.0, 4000)), "SOG": {"remark": "stopped"}}
    files = {
        "+0": file_of(1900),
        "+20": {"goal": 60.0, "remark": "out of reach", "seconds": 1.0},
    }
    whole = {"splats": 100, "sh_degree": 3, "plain": plain, "peers": peers}
    simplified = {**whole, "simplified": files}
    return {
        "plane3": Measured(simplified),
        "lego60k": Measured(simplified),
        "donut": Measured({**whole, "sh_degree": 0}),
    }


def test_the_table_divides_by_the_peer_and_says_which_aims_are_met():
    lines = distortion_tables.tables(results()).splitlines()
    plane, lego, donut = lines[1].split(), lines[2].split(), lines[3].split()
    assert ["plane3", "100,", "3", "40.00", "at", "40.0", "20.00"] == plane[:7]
    assert "0.500 0.7: met" in " ".join(plane)
    assert "19.00 (60 scalar for 40.0) 0.475 0.4: missed" in " ".join(plane)
    assert "0.475 0.55: met" in " ".join(lego)
    assert ["-", "-", "-"] == donut[-3:]


def test_tables_state_what_was_simplified_and_what_was_not_reached():
    lines = [line.split() for line in distortion_tables.tables({"plane3": results()["plane3"]}).splitlines()]
    assert ["plane3", "40.0", "19.00", "scalar", "60", "20.00", "0.950", "7", "5"] in lines
    assert ["plane3", "60.0", "-", "-", "-", "-", "-", "-", "1"] in lines


def test_tables_state_the_psnr_at_the_bytes_that_are_aimed_at():
    lines = [line.split() for line in distortion_tables.tables({"plane3": results()["plane3"]}).splitlines()]
    # 2,800 and 1,600 bytes on the line from 1,000 at 38 dB to 4,000 at 42.
    assert ["plane3", "40.0", "28.00", "41.0", "16.00", "39.4", "39.5"] in lines


def test_whole_files_count_where_simplified_ones_are_larger():
    values = results()["plane3"].values
    one = Measured({**values, "simplified": {"+0": file_of(2500)}})
    assert "balanced, codebook" == one.simplified_rate(40.0).how
    assert one.simplified_rate(40.1) is None  # nothing was simplified to that


def test_markdown_has_a_rule_below_each_header():
    lines = distortion_tables.tables(results(), markdown=True).splitlines()
    assert lines[1].count("---") == lines[0].count("|") - 1


def test_plots_the_same_bytes_for_the_same_results(tmp_path):
    written = []
    for _ in range(2):
        distortion_plot.plot(results(), tmp_path / "curves.svg")
        written.append((tmp_path / "curves.svg").read_bytes())
    assert written[0] == written[1]
    distortion_plot.plot({}, tmp_path / "none.svg")
    assert not (tmp_path / "none.svg").exists()


def test_what_was_measured_is_not_measured_again(tmp_path):
    path, calls = tmp_path / "one.json", []

    def call():
        calls.append(1)
        return len(calls)

    assert 1 == Kept(path).measure("kind", "key", call)
    assert 1 == Kept(path).measure("kind", "key", call)
    assert {"kind": {"key": 1}} == json.loads(path.read_text())
    assert 2 == Kept(path, again=True).measure("kind", "key", call)


def test_an_ablation_takes_away_one_part_at_a_time_and_puts_it_back(tmp_path, monkeypatch, capsys):
    parts = []

    def encode_to(source, *, psnr, options, no_prune, simplifying):
        tunes = (
            subsets.quantisation_aware_refit is splat_refit.quantisation_aware_refit and target_search.REFIT_GAIN > 0.0
        )
        prices = math.isfinite(splat_refit.rate_exponent(0.05))
        has = (tunes, prices, options.max_classes != 1, simplifying.bands, simplifying.refit, not no_prune)
        parts.append(has)
        report = SearchReport({"psnr": psnr}, 1000, 9, len(source), 3, 1.0, chosen={"psnr": psnr, "splats": 9})
        return SimpleNamespace(data=bytes(1000 + 100 * has.count(False)), report=report)

    monkeypatch.setattr(ablation, "encode_to", encode_to)
    words = ["--scenes", "sample", "--psnr", "34", "--out", str(tmp_path)]
    assert 0 == command(ablation.main, words)
    assert [True] * 6 == list(parts[0])
    assert sorted([tuple(at != part for at in range(6)) for part in range(6)]) == sorted(parts[1:])
    assert "1.1 (+10%)" in capsys.readouterr().out
    assert 0 == command(ablation.main, words)  # all is known
    assert 7 == len(parts)


def test_measures_whole_and_simplified_files_beside_a_peer_and_goes_on_where_it_ended(tmp_path, monkeypatch, capsys):
    """Compare a part of the scene that ships with a peer that was judged before."""
    part = tmp_path / "part.ply"
    write_ply(part, read_ply(scenes.SAMPLE).select(slice(None, None, 4)))
    monkeypatch.setattr(scenes, "SAMPLE", part)
    known = tmp_path / "sample.json"
    known.write_text(json.dumps({"peers": {"SPZ": asdict(Point(36.0, 60_000))}}))
    monkeypatch.setattr(distortion, "find_splat_transform", lambda _: (["none"], "judged before"))
    monkeypatch.setattr(distortion, "GRID", (-3.0,))
    chosen = {"psnr": 36.1, "size_bytes": 30_000, "splats": 900, "sh_coding": "scalar"}
    searches = []

    def encode_to(source, *, psnr, views):
        searches.append((psnr, len(views.training), len(views.test)))
        return Optimised(None, SearchReport({"psnr": psnr}, 30_000, 900, len(source), 7, 5.0, chosen=chosen))

    monkeypatch.setattr(distortion, "encode_to", encode_to)

    def run(what):
        args = ["--views", "20", "--scenes", "sample", "--cache", str(tmp_path / "scenes"), "--out", str(tmp_path)]
        assert 0 == command(distortion.main, [what, *args])
        return capsys.readouterr()

    assert "sample balanced" in run("plain").err
    assert "0.500" in run("simplified").out
    assert [(36.0, 36, 8)] == searches
    one = Measured(json.loads(known.read_text()))
    assert rate_at(one.plain(), 36.0).measured is None  # enclosed
    before = known.read_bytes()
    assert "sample balanced" not in run("plain").err  # nothing is left to do
    assert before == known.read_bytes()
