# SPDX-License-Identifier: Apache-2.0
"""The search for a target on analytic scenes: the file it finds, and the number of candidates."""

from dataclasses import replace
from functools import cache

import pytest
from analytic_search import AnalyticScene, Views, search
from tables import failures

from csplat import EncodeOptions, InputError
from csplat_tools.optimise.candidates import Coding

PLAIN = AnalyticScene()
UNNEEDED = AnalyticScene(unneeded=4000)
NONE_TO_SPARE = AnalyticScene(removal_psnr=2.0)
NO_CODEBOOK = AnalyticScene(book_psnr=20.0, book_octave=0.1)
WITHOUT_SH = AnalyticScene(sh_degree=0, shown=())
JUMPING = AnalyticScene(jump=0.5)
SCENES = {
    "plain": PLAIN, "many unneeded splats": UNNEEDED, "no splat to spare": NONE_TO_SPARE,
    "useless codebooks": NO_CODEBOOK, "without SH": WITHOUT_SH, "jumps": JUMPING,
    "cheap codebooks": AnalyticScene(index_bytes=0.5, entry_bytes=2.0), "few bytes per dB": AnalyticScene(rate=0.04),
    "many bytes per dB": AnalyticScene(rate=0.07), "quality far from renders": AnalyticScene(lost=16.0),
}  # fmt: skip
MOST_TRIES = 25  # candidates; a codebook that has to grow takes some more
LARGER = 1.12  # times the size of the smallest possible file; the limit of a search for a PSNR


@cache
def found_in(name, *, no_prune, **target):
    """Search in one of the scenes, once per target."""
    return search(SCENES[name], no_prune=no_prune, **target)


def each(names=tuple(SCENES)):
    """Return arguments `(name, no_prune)` for some scenes, with all splats and with fewer."""
    return {f"{name}{', all splats' * no_prune}": (name, no_prune) for name in names for no_prune in (True, False)}


def assert_few_different(tried):
    assert len({repr(file.contents) for file in tried}) == len(tried) <= MOST_TRIES


@pytest.mark.slow
@pytest.mark.parametrize("goal", [30.0, 38.0])
def test_a_psnr_is_reached_by_nearly_the_smallest_file(goal):
    def check(case):
        name, no_prune = case
        found = found_in(name, no_prune=no_prune, psnr=goal)
        # A margin of 0.1 dB, and what another file would not be worth: 0.16 dB for all splats.
        assert goal <= found.file.psnr() <= goal + 0.27 + SCENES[name].jump
        assert len(found.file) <= LARGER * SCENES[name].smallest(goal, no_prune=no_prune)
        packed = [file for file in found.scored if file.contents.options.deflate_level is None]
        assert len(found.file) == min(len(file) for file in packed if file.psnr() >= goal)
        if goal == 38.0:
            assert_few_different(found.tried)

    assert [] == failures(each(), check)


@pytest.mark.slow
@pytest.mark.parametrize("goal", [60_000, 90_000])
def test_a_size_is_filled_by_nearly_the_best_file(goal):
    def check(case):
        name, no_prune = case
        found = found_in(name, no_prune=no_prune, size=goal)
        assert 0.95 * goal <= len(found.file) <= goal
        if goal == 90_000:
            worse = SCENES[name].best(goal, no_prune=no_prune) - found.file.psnr()
            assert worse <= (2.2 if no_prune else 5.0)  # dB
            assert_few_different(found.tried)

    assert [] == failures(each(), check)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.2, 1.0])
def test_a_psnr_drop_is_met_by_nearly_the_smallest_file(loss):
    photographs = Views(photo_psnr=25.0)

    def check(case):
        name, no_prune = case
        found = search(SCENES[name], no_prune=no_prune, max_psnr_drop=loss, photo_psnr=25.0)
        assert 0.85 * loss <= 25.0 - found.file.psnr(photographs) <= loss
        assert len(found.file) <= 1.15 * SCENES[name].smallest(25.0 - loss, photographs, no_prune=no_prune)

    assert [] == failures(each(("plain", "useless codebooks", "without SH")), check)


@pytest.mark.slow
def test_a_psnr_is_reached_in_difficult_scenes():
    def check(case):
        scene, goal, no_prune, above, larger = case
        found = search(scene, psnr=goal, no_prune=no_prune)
        assert goal <= found.file.psnr() <= goal + above
        assert len(found.file) <= larger * scene.smallest(goal, no_prune=no_prune)
        assert len(found.tried) <= 2 * MOST_TRIES
        assert no_prune or found.file.contents.splats < 8000
        assert found.file.contents.options.deflate_level is None

    cases = {
        # Between 42 and 55 dB of quality more bytes gain nothing.
        "a plateau": (replace(WITHOUT_SH, plateau=(42.0, 55.0)), 34.0, True, 0.3, LARGER),
        "jumps": (replace(NO_CODEBOOK, jump=1.5), 35.1, True, 2.0, 1.1),
        "larger by stronger compression": (replace(NO_CODEBOOK, packing=0.97), 38.0, True, 0.3, LARGER),
        "larger by stronger compression, without SH": (replace(WITHOUT_SH, packing=0.97), 38.0, True, 0.3, LARGER),
        # The gain of a refit predicts the next number of splats.
        "small gain": (replace(PLAIN, mended=1.0), 42.0, False, 0.3, 1.03),
        "usual gain": (replace(PLAIN, mended=3.0), 38.0, False, 0.3, 1.03),
        "large gain": (replace(PLAIN, mended=12.0), 34.0, False, 0.3, 1.03),
        # A refit through the quantisers makes a file worse by 4 dB: the number of splats is raised, not given up.
        "a failed number of splats": (replace(PLAIN, tuned=-4.0), 32.0, False, 0.4, 2.0),
        "other codings of it": (replace(PLAIN, tuned=-4.0, mended=12.0), 36.0, False, 2.0, 2.0),
    }
    assert [] == failures(cases, check)


def test_an_impossible_target_is_refused_after_few_candidates():
    def check(case):
        scene, message, goal = case
        tried = []
        with pytest.raises(InputError, match=message):
            search(scene, tried=tried, **goal)
        assert 0 < len(tried) <= MOST_TRIES

    low, middle, high = (replace(PLAIN, ceiling=ceiling) for ceiling in (36.0, 50.0, 97.0))
    no_file = "no file reaches 98.00 dB; the best found has"
    cases = {
        "98 dB of 36": (low, no_file, {"psnr": 98.0}),
        "98 dB of 97": (high, no_file, {"psnr": 98.0}),
        "98 dB of 97, all splats": (high, no_file, {"psnr": 98.0, "no_prune": True}),
        "38 dB of 36": (low, "no file reaches 38.00 dB; the best found has 36", {"psnr": 38.0, "no_prune": True}),
        "size": (PLAIN, "no file has at most 300 bytes; the smallest found has", {"size": 300}),
        "size, all": (PLAIN, "no file with all splats has at most 300 bytes", {"size": 300, "no_prune": True}),
        # At any precision, the error of a file equals that of the images.
        "drop": (middle, "no file reaches 49.50 dB on the valid", {"max_psnr_drop": 0.5, "photo_psnr": 50.0}),
        # Errors of means only depend on the quality; the bound requires more of it than the goal.
        "bound": (PLAIN, "no file reaches", {"psnr": 30.0, "no_prune": True, "max_error": {"means": 1e-3}}),
    }
    assert [] == failures(cases, check)
    loose = search(PLAIN, no_prune=True, psnr=30.0, max_error={"means": 10.0**-1.5})
    assert 30.0 <= loose.file.psnr() <= 30.3


def test_a_psnr_below_all_files_is_exceeded_with_a_note():
    for no_prune in (True, False):
        found, met = search(PLAIN, psnr=2.0, no_prune=no_prune), found_in("plain", no_prune=no_prune, psnr=38.0)
        assert len(found.file) <= PLAIN.smallest(2.0, no_prune=True)
        assert any("no smaller file of those tried reaches the target" in line for line in found.report.why)
        assert not any("no smaller file" in line for line in met.report.why)


def test_a_search_in_many_splats_stops_where_files_take_longer_than_their_saving_is_worth():
    scenes = (replace(PLAIN, mended=12.0, splats=splats) for splats in (8000, 400_000))
    few, many = (search(scene, psnr=34.0) for scene in scenes)
    less, more = (sum(not file.contents.draft for file in found.tried) for found in (many, few))
    assert less < more
    assert 34.0 <= min(few.file.psnr(), many.file.psnr())


def test_a_size_prunes_splats_if_that_raises_the_psnr_or_all_exceed_it():
    better = {}
    for name in ("plain", "without SH", "many unneeded splats", "no splat to spare"):
        fewer, all_stay = (found_in(name, no_prune=no_prune, size=90_000).file for no_prune in (False, True))
        better[name] = round(fewer.psnr() - all_stay.psnr(), 2)
    assert better.pop("no splat to spare") > -0.6
    assert better.pop("many unneeded splats") > 5.0
    assert min(better.values()) > 0.0, better
    with pytest.raises(InputError, match="no file with all splats has"):
        search(PLAIN, size=12_000, no_prune=True)
    found = search(PLAIN, size=12_000)
    assert 0.9 * 12_000 <= len(found.file) <= 12_000
    assert found.file.contents.splats < 4000


def test_a_low_effort_tries_fewer_candidates():
    brief = search(PLAIN, psnr=38.0, effort=1)
    assert len(brief.tried) < len(found_in("plain", no_prune=False, psnr=38.0).tried)
    assert 38.0 <= brief.file.psnr() <= 38.4


@pytest.mark.parametrize(
    "goal", [{"psnr": 38.0}, {"size": 90_000}, {"max_psnr_drop": 0.5, "photo_psnr": 25.0}],
    ids=["PSNR", "size", "drop"],
)  # fmt: skip
def test_test_views_choose_nothing(goal):
    one, other = (search(PLAIN, judging=judging, **goal) for judging in (Views(), Views(3.0, 5.0)))
    assert one.file.contents == other.file.contents
    assert one.report.psnr > other.report.psnr
    assert {one.file} == set(one.scored)


def test_codings_are_chosen_by_their_gain_or_by_the_caller():
    def check(case):
        scene, expected = case
        found = search(scene, psnr=38.0, no_prune=True)
        assert expected.items() <= found.report.chosen.items()
        assert len(found.tried) <= MOST_TRIES

    # Files with codebooks come within a decibel of the goal and stay there, nearer than the others at first.
    little_gain = replace(PLAIN, book_psnr=37.2, book_octave=0.05, index_bytes=0.1, entry_bytes=0.1)
    cases = {
        "plain": (PLAIN, {"sh_coding": "codebook"}),
        "useless codebooks": (NO_CODEBOOK, {"sh_coding": "scalar", "sh_degree": 3}),
        "barely visible bands": (replace(NO_CODEBOOK, shown=(30.0, 45.0, 50.0)), {"sh_degree": 1}),
        "hardly any SH": (AnalyticScene(shown=(48.0, 52.0, 56.0)), {"sh_coding": "none"}),
        "no SH": (WITHOUT_SH, {"sh_coding": "none"}),
        "little gain from precision": (little_gain, {"sh_coding": "scalar"}),
    }
    assert [] == failures(cases, check)
    fast = search(PLAIN, psnr=38.0, no_prune=True, options=EncodeOptions("fast"))
    assert {"scalar", "none"} >= {candidate["sh_coding"] for candidate in fast.report.tried}
    for fixed in ({"sh_degree": 1, "sh_coding": "scalar"}, {"sh_coding": "codebook", "codebook_size": 64}):
        for file in search(PLAIN, psnr=28.0, options=EncodeOptions(**fixed)).tried:
            assert fixed == {name: getattr(file.contents.options, name) for name in fixed}


def test_a_codebook_grows_until_the_goal_is_reached():
    # With smaller codebooks no precision reaches the goal; the second scene may have an entry per four splats.
    small = replace(PLAIN, splats=6000, book_psnr=29.0)
    for scene, least, most in ((replace(PLAIN, book_psnr=32.0), 1024, 8000), (small, 2048, 2048)):
        found = search(scene, psnr=38.0, no_prune=True, options=EncodeOptions(sh_coding="codebook"))
        assert found.file.psnr() >= 38.0
        assert least <= found.report.chosen["codebook_size"] <= most
    # Precision hardly lowers the errors of the first codebooks, while scalar coding reaches the goal at once.
    scene = AnalyticScene(splats=30_000, book_psnr=28.0, book_octave=3.5, index_bytes=0.8, entry_bytes=2.0)
    found = search(scene, psnr=38.0, no_prune=True)
    scalar = search(scene, psnr=38.0, no_prune=True, options=EncodeOptions(sh_coding="scalar"))
    assert len(found.file) < 0.85 * len(scalar.file)
    assert len(found.tried) <= MOST_TRIES


def test_quantisation_classes_are_used_if_files_become_smaller():
    graded, dearer, unknown = (
        search(replace(PLAIN, grading=grading), psnr=38.0, no_prune=True, grades=grades)
        for grading, grades in ((0.9, True), (1.1, True), (0.9, False))
    )
    assert [2, 1, 1] == [found.report.chosen["classes"] for found in (graded, dearer, unknown)]
    assert any("2 quantisation classes" in line for line in graded.report.why)


def test_a_preset_whose_own_file_is_smaller_is_chosen():
    for preset, goal in (("balanced", 43.2), ("small", 38.3)):
        scenes = (replace(NO_CODEBOOK, removal_psnr=2.0, preset_saving=(preset, share)) for share in (0.0, 0.2))
        usual, saving = (search(scene, psnr=goal, no_prune=True) for scene in scenes)
        assert (preset, None) == (saving.report.chosen["preset"], saving.report.chosen["attribute_psnr"])
        assert any("at the precision of the preset" in line for line in saving.report.why)
        assert len(saving.file) < len(usual.file)
        assert usual.report.chosen["attribute_psnr"] is not None


def test_unneeded_splats_are_pruned_unless_pruning_is_off():
    fewer, all_stay = (found_in("many unneeded splats", no_prune=no_prune, psnr=38.0) for no_prune in (False, True))
    assert fewer.file.contents.splats <= 4000
    assert 8000 == all_stay.file.contents.splats
    assert any("pruned, the others" in line for line in fewer.report.why)
    assert not any("pruned, the others" in line for line in all_stay.report.why)
    assert len(fewer.file) < 0.6 * len(all_stay.file)
    assert 8000 == found_in("no splat to spare", no_prune=False, psnr=45.0).file.contents.splats


def test_the_report_lists_every_candidate():
    found = found_in("plain", no_prune=False, psnr=38.0)
    report = found.report
    assert {"psnr": 38.0} == report.goal
    assert [len(file) for file in found.tried] == [one["size_bytes"] for one in report.tried]
    assert (len(found.tried), len(found.file)) == (report.encodes, report.size_bytes)
    assert found.file in found.scored
    assert len(set(found.scored)) == sum(one["psnr"] is not None for one in report.tried)
    assert report.psnr == pytest.approx(found.file.psnr())
    assert report.chosen in report.tried
    assert any(line.startswith("tried for these splats, too") for line in report.why)


def test_files_of_a_search_have_full_tiles():
    tiles = {EncodeOptions(): 65536, EncodeOptions(tile_splats=100): 100}
    assert tiles == {options: Coding().options(options, 40_000, None).tile_splats for options in tiles}
