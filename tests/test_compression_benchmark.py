"""The benchmark of compressions: sizes by arithmetic, the control without quantisers, what is kept, a whole run."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba", reason="compression wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("PIL.Image", reason="pictures want the extra [render]")

from captures import cameras, photograph, shell

from csplat import EncodeOptions
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.errors import InputError
from csplat_bench.common.captures import CAPTURES, choose_captures
from csplat_bench.common.command import run as command
from csplat_bench.common.kept import Kept
from csplat_bench.common.making import with_splats
from csplat_bench.common.measuring import alone
from csplat_bench.compression.__main__ import main
from csplat_bench.compression.controls import Unquantised, eight_bits
from csplat_bench.compression.memory import finetuned
from csplat_bench.compression.sizes import Book, books_of, float_bytes, integer_bytes, integer_columns, ply_bytes
from csplat_bench.compression.tables import tables
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune

pytestmark = pytest.mark.area(name="benchmarks")

BLACK = np.zeros(3, np.float32)
BOOKS = EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16, shape_codebook_size=32)


@pytest.fixture(scope="module")
def source():
    return shell(15)


@pytest.fixture(scope="module")
def capture(source, tmp_path_factory):
    return photograph(source, tmp_path_factory.mktemp("capture"))


# sizes


def test_floats_are_counted_by_hand():
    assert 248 * 10 == ply_bytes(10)
    assert 4 * 59 * 10 == float_bytes(10, 45, None, None)  # all but the normals
    colours, shapes = Book(300, 2), Book(200, 3)
    assert 10 * (4 * 14 + 2) + 4 * 45 * 302 == float_bytes(10, 45, colours, None)  # 301 values of an index: two bytes
    assert 10 * (4 * 7 + 2 + 1 + 4) + 4 * 45 * 302 + 4 * 7 * 203 == float_bytes(10, 45, colours, shapes)


def test_integers_take_whole_bytes_by_the_range_of_their_column():
    columns = np.array([[0, -128, 7, 0], [255, 128, 7, 70_000]])  # 256 and 257 values, one, and 70,001
    assert 2 * (1 + 2 + 0 + 3) == integer_bytes([columns])
    assert 0 == integer_bytes([np.zeros((0, 3), np.int64)])


@pytest.mark.parametrize("options", [BOOKS, EncodeOptions(attribute_psnr=28.0, sh_coding="scalar")])
def test_integers_of_a_fixed_quantisation_are_as_many_as_its_file_holds(source, options):
    fixed = fix_quantisation(EncodePlan.of(source, options))
    colours, shapes = books_of(fixed)
    n = len(source)
    rows = n if colours is None else colours.entries + colours.escaped
    by_shape = n if shapes is None else shapes.entries + shapes.escaped
    wanted = n * (3 + 1 + 3) + rows * 45 + by_shape * 6
    wanted += (0 if colours is None else n) + (0 if shapes is None else 2 * n)  # indices, and the splats' own sizes
    assert wanted == sum(array.size for array in integer_columns(fixed, fixed.start()))


def test_a_file_is_smaller_than_its_integers(source):
    fixed = fix_quantisation(EncodePlan.of(source, EncodeOptions(attribute_psnr=45.0, sh_coding="scalar")))
    assert len(fixed.encode(fixed.start()).write().data) < integer_bytes(integer_columns(fixed, fixed.start()))


# controls


def test_without_quantisers_the_values_themselves_are_seen_and_move_freely(source):
    plain = fix_quantisation(
        EncodePlan.of(source, EncodeOptions(preset="fast", attribute_psnr=30.0, sh_coding="scalar"))
    )
    fixed = Unquantised.freeing(plain)
    start = fixed.start()
    for name in ("means", "scales", "opacities", "sh0"):
        assert np.array_equal(getattr(source, name)[fixed.source_index], getattr(fixed.dequantise(start), name)) or (
            name == "scales"  # in their gauge
        )
    assert not np.array_equal(plain.dequantise(plain.start()).sh0, fixed.dequantise(start).sh0)
    start.means += 100.0
    moved = start.means.copy()
    fixed.constrain(start)
    assert np.array_equal(moved, start.means)


def test_the_control_learns(source):
    wanted = renders_of(source, cameras(10), BLACK, None)
    off = replace(source, sh0=source.sh0 + np.float32(0.3))
    fixed = Unquantised.freeing(fix_quantisation(EncodePlan.of(off, EncodeOptions(preset="fast", sh_coding="scalar"))))
    options = FinetuneOptions(iterations=60, warm_up=10, validate_every=20, byte_cost=0.0)
    log = tune(fixed, split_views(wanted, BLACK, validation_count=2), options).log
    assert log["best_psnr"] > log["start_psnr"] + 3.0


def test_eight_bits_are_256_values_between_the_extremes(source):
    options = eight_bits(source, EncodeOptions())
    for values, step in ((source.scales, options.scale_step), (source.sh0, options.sh0_step)):
        assert 256 == round(float(np.ptp(values)) / step) + 1
    assert (16, 255, 127) == (options.position_bits, options.opacity_levels, options.quat_levels)
    flat = replace(source, sh0=np.zeros_like(source.sh0), shN=source.shN[:, :0])
    assert eight_bits(flat, EncodeOptions()).sh0_step > 0.0


@pytest.mark.parametrize("count", [100, 300, 1000])
def test_scenes_of_any_number_of_splats_can_be_made(source, count):
    found = with_splats(source, count)
    assert count == len(found)
    assert float(np.abs(found.means).max()) < 3.0


# what is kept


def test_results_are_measured_once_and_only_by_one_way(tmp_path):
    path, calls = tmp_path / "s.json", []

    def measured():
        calls.append(1)
        return {"psnr": 30.0}

    for _ in range(2):
        kept = Kept(path, {"steps": 5})
        assert {"psnr": 30.0} == kept.measure("main", "main", measured)
    assert [1] == calls
    assert (True, False) == (kept.knows("main", "main"), kept.knows("main", "other"))
    with pytest.raises(InputError, match="steps 5, wanted 6: name another --out"):
        Kept(path, {"steps": 6})


def test_scenes_are_chosen_by_name(tmp_path):
    for names, extra, message in (
        (["lego9"], [], "no scene is called lego9"),
        ([], [f"a,a.ply,{tmp_path},10"], "wanted NAME,PLY,DATA,WxH"),
        ([], [f"a,{tmp_path / 'a.ply'},{tmp_path},-"], "a.ply does not exist"),
    ):
        with pytest.raises(InputError, match=message):
            choose_captures(names, extra)
    (tmp_path / "a.ply").touch()
    (scene,) = choose_captures([], [f"a,{tmp_path / 'a.ply'},{tmp_path},64x48"])
    assert ("a", (64, 48), None) == (scene.name, scene.size, scene.training)
    assert 20_000 == CAPTURES["lego20k"].training.max_splats


# the whole


def run(capture, out, *words):
    extra = ("--scenes", "", "--extra", f"shell,{capture / 'scene.ply'},{capture},-")
    small = ("attribute_psnr=30", "shape_codebook_size=32", "codebook_size=16")
    knobs = [word for knob in small for word in ("--knob", knob)]
    return command(main, list(map(str, (*words, *extra, *knobs, "--iterations", 40, "--threads", 1, "--out", out))))


def test_everything_is_measured_and_printed(capture, tmp_path, capsys):
    lists = ("--sizes", 16, "--escapes", 0.1, "--bits", 12, "--keep", "0.6,0.5")
    parts = ("main", "control", "others", "sizes", "escapes", "positions", "curve")
    assert 0 == run(capture, tmp_path, *parts, *lists)
    printed = capsys.readouterr().out
    known = json.loads((tmp_path / "shell.json").read_text())
    facts, row = known["facts"]["scene"], known["main"]["main"]
    assert (301, 14, 2) == (facts["splats"], facts["train_views"], facts["test_views"])
    assert 300 == row["splats"]
    steps = {one["row"].split(" (")[0]: one for one in known["ablation"]["main"]}
    order = ["none", "prune unseen", "+ colour codebook", "+ shape codebook", "+ quantisation", "+ fine-tuning"]
    assert [*order, "+ entropy coding", "+ Morton order"] == list(steps)
    assert (301 * 248, 300 * 248) == (steps["none"]["size_bytes"], steps["prune unseen"]["size_bytes"])
    assert steps["none"]["psnr"] == pytest.approx(steps["prune unseen"]["psnr"], abs=1e-3)
    assert steps["+ Morton order"]["size_bytes"] == row["after_bytes"]
    # The tuned scene in memory, and files of it in either order, score the same.
    tuned = [steps[name]["psnr"] for name in ("+ fine-tuning", "+ entropy coding", "+ Morton order")]
    assert tuned == pytest.approx([row["after"]["psnr"]] * 3, abs=1e-5)
    assert steps["+ quantisation"]["psnr"] == pytest.approx(row["before"]["psnr"], abs=1e-5)
    assert row["after"]["psnr"] > row["before"]["psnr"]
    assert known["control"]["main"]["scores"]["trained on"]["psnr"] > 0.0
    assert 0.1 == pytest.approx(known["escapes"]["SH 10 %"]["sh_escapes"], abs=0.01)
    assert 181 == known["curve"]["keep 0.6"]["splats"]
    assert ["keep 0.6", "keep 0.5"] == list(known["curve"])
    for title in ("Ablation", "Control", "Codebook sizes", "Thresholds", "Bits per axis", "Simplified", "Time"):
        assert title in printed
    # The second time nothing is measured, and other settings are refused.
    assert 0 == run(capture, tmp_path, *parts, *lists, "--markdown")
    again = capsys.readouterr()
    assert "main main" not in again.err
    assert "| none | PLY | 74,648 | 248.00 | 1.0 |" in again.out
    assert 1 == run(capture, tmp_path, "main", "--byte-cost", "0.1")
    assert "error: shell: " in capsys.readouterr().err


def test_wrong_words_are_refused_before_anything_is_measured(capture, tmp_path, capsys):
    for words, message in (
        (("mian",), "mian cannot be measured"),
        (("main", "--keep", "1.5"), "a share of splats is to be more than 0"),
        (("main", "--bits", "40"), "position_bits is 40"),
        (("main", "--sizes", "x"), "invalid literal"),
    ):
        assert 2 == run(capture, tmp_path / "out", *words)
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_peak_memory_is_that_of_the_command(capture, tmp_path):
    words = ["--data", str(capture), "--iterations", "3", "--threads", "1", "--quiet"]
    before, peak = alone(finetuned, [str(capture / "scene.ply"), "-o", str(tmp_path / "s.csplat"), *words])
    assert 1e7 < before < peak < 3e9
    assert (tmp_path / "s.csplat").exists()


def test_nothing_is_printed_of_what_is_not_known():
    assert "" == tables({})
    assert "" == tables({"half": {"settings": {}}})
