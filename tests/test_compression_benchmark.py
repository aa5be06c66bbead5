"""The benchmark of compressions: sizes by arithmetic, the control without quantisers, what is kept, a whole run."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="compression wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
Image = pytest.importorskip("PIL.Image", reason="pictures want the extra [render]")

BENCHMARKS = Path(__file__).resolve().parent.parent / "tools" / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

# They lie in the folder that is named above.
from captures import H, W, cameras, photograph, shell  # noqa: E402

from compression import main  # noqa: E402
from compression_controls import Unquantised, cluster_colours, eight_bits, histogram  # noqa: E402
from compression_memory import with_splats  # noqa: E402
from compression_scenes import SCENES, Kept, choose_scenes  # noqa: E402
from compression_sizes import (  # noqa: E402
    Book,
    books_of,
    coded_colour_bytes,
    float_bytes,
    integer_bytes,
    integer_columns,
    ply_bytes,
)
from compression_tables import tables  # noqa: E402
from csplat import EncodeOptions  # noqa: E402 - wants what is looked for above; so do all below
from csplat.encoder import Draft  # noqa: E402
from csplat.errors import InputError  # noqa: E402
from csplat_trainer.finetune import FinetuneOptions, finetune, renders_of, split_views  # noqa: E402
from csplat_trainer.sensitivity import measure_sensitivity  # noqa: E402

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


def test_an_index_that_says_escaped_needs_room_for_it():
    assert 100 + 255 * 45 + 300 == coded_colour_bytes(100, 45, Book(255, 0), base=False)
    assert 200 + 256 * 45 + 300 == coded_colour_bytes(100, 45, Book(256, 0), base=False)
    assert 200 + 257 * 48 == coded_colour_bytes(100, 45, Book(256, 1), base=True)


def test_integers_take_whole_bytes_by_the_range_of_their_column():
    columns = np.array([[0, -128, 7, 0], [255, 128, 7, 70_000]])  # 256 and 257 values, one, and 70,001
    assert 2 * (1 + 2 + 0 + 3) == integer_bytes([columns])
    assert 0 == integer_bytes([np.zeros((0, 3), np.int64)])


@pytest.mark.parametrize(
    "options", [BOOKS, replace(BOOKS, codebook_stages=2), EncodeOptions(attribute_psnr=28.0, sh_coding="scalar")]
)
def test_integers_of_a_frozen_scene_are_as_many_as_its_file_holds(source, options):
    frozen = Draft.of(source, options).frozen()
    colours, shapes = books_of(frozen)
    n = len(source)
    rows = n if colours is None else colours.entries + colours.escaped
    by_shape = n if shapes is None else shapes.entries + shapes.escaped
    wanted = n * (3 + 1 + 3) + rows * 45 + by_shape * 6
    wanted += n * len(frozen.stages) + (0 if shapes is None else 2 * n)  # indices, and the splats' own sizes
    assert wanted == sum(array.size for array in integer_columns(frozen, frozen.start()))


def test_a_file_is_smaller_than_its_integers(source):
    frozen = Draft.of(source, EncodeOptions(attribute_psnr=45.0, sh_coding="scalar")).frozen()
    assert len(frozen.coded(frozen.start()).write().data) < integer_bytes(integer_columns(frozen, frozen.start()))


# controls


def test_without_quantisers_the_values_themselves_are_seen_and_move_freely(source):
    plain = Draft.of(source, EncodeOptions(preset="fast", attribute_psnr=30.0, sh_coding="scalar")).frozen()
    frozen = Unquantised.of(plain)
    start = frozen.start()
    for name in ("means", "scales", "opacities", "sh0"):
        assert np.array_equal(getattr(source, name)[frozen.source_index], getattr(frozen.seen(start), name)) or (
            name == "scales"  # in their gauge
        )
    assert not np.array_equal(plain.seen(plain.start()).sh0, frozen.seen(start).sh0)
    start.means += 100.0
    moved = start.means.copy()
    frozen.constrain(start)
    assert np.array_equal(moved, start.means)


def test_the_control_learns(source):
    wanted = renders_of(source, cameras(10), BLACK, None)
    off = replace(source, sh0=source.sh0 + np.float32(0.3))
    frozen = Unquantised.of(Draft.of(off, EncodeOptions(preset="fast", sh_coding="scalar")).frozen())
    options = FinetuneOptions(iterations=60, warm_up=10, validate_every=20, byte_cost=0.0)
    log = finetune(frozen, split_views(wanted, BLACK, aside=2), options).log
    assert log["best_psnr"] > log["start_psnr"] + 3.0


def test_colours_by_codebook_come_from_few_entries_but_for_those_that_escape(source):
    weights = np.ones(300, np.float32)
    served, book = cluster_colours(source, weights, 20, 0.01, 0.1, base=True, seed=0, threads=1)
    assert (True, 30) == (book.entries <= 20, book.escaped)
    rows = np.concatenate([served.sh0[:, None], served.shN], axis=1).reshape(300, -1)
    assert book.entries < len(np.unique(rows, axis=0)) <= book.entries + 30
    assert 30 <= np.count_nonzero((served.sh0 == source.sh0).all(axis=1))
    without, _ = cluster_colours(source, weights, 20, 0.01, 0.1, base=False, seed=0, threads=1)
    assert np.array_equal(source.sh0, without.sh0)
    assert not np.array_equal(source.shN, without.shN)


def test_eight_bits_are_256_values_between_the_extremes(source):
    options = eight_bits(source, EncodeOptions())
    for values, step in ((source.scales, options.scale_step), (source.sh0, options.sh0_step)):
        assert 256 == round(float(np.ptp(values)) / step) + 1
    assert (16, 255, 127) == (options.position_bits, options.opacity_levels, options.quat_levels)
    flat = replace(source, sh0=np.zeros_like(source.sh0), shN=source.shN[:, :0])
    assert eight_bits(flat, EncodeOptions()).sh0_step > 0.0


def test_shares_of_sensitivities_add_up(source):
    unseen = replace(source, means=source.means + np.where(np.arange(300)[:, None] < 30, 400.0, 0.0).astype("f4"))
    found = histogram(measure_sensitivity(unseen, cameras(4)))
    for shares in found["shares"].values():
        assert sum(shares) == pytest.approx(1.0)
        assert shares[0] >= 0.1
    assert 0.0 < found["above"]["colour"] <= 0.9
    assert found["unseen"] == pytest.approx(found["shares"]["colour"][0])


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
        kept = Kept(path, {"steps": 5}, lambda _: None)
        assert {"psnr": 30.0} == kept.measure("main", "main", measured)
    assert [1] == calls
    assert (True, False) == (kept.knows("main", "main"), kept.knows("main", "other"))
    with pytest.raises(InputError, match="steps 5, wanted 6: name another --out"):
        Kept(path, {"steps": 6}, lambda _: None)


def test_scenes_are_chosen_by_name(tmp_path):
    for words, message in (
        ((["lego9"], [], []), "no scene is called 'lego9'"),
        (([], ["x=a.ply"], []), "no scene is called 'x'"),
        (([], [], [["a", "a.ply", str(tmp_path), "10"]]), "size of a is '10'"),
        (([], [], [["a", str(tmp_path / "a.ply"), str(tmp_path), "-"]]), "a.ply does not exist"),
    ):
        with pytest.raises(InputError, match=message):
            choose_scenes(*words)
    (tmp_path / "a.ply").touch()
    (scene,) = choose_scenes([], [], [["a", str(tmp_path / "a.ply"), str(tmp_path), "64x48"]])
    assert ("a", (64, 48), None) == (scene.name, scene.size, scene.training)
    assert 20_000 == SCENES["lego20k"].training.max_splats


# the whole


def run(capture, out, *words):
    extra = ("--scenes", "", "--extra", "shell", capture / "scene.ply", capture, "-")
    small = ("--iterations", 40, "--attribute-psnr", 30, "--shapes", 32, "--codebook-size", 16, "--threads", 1)
    return main([str(word) for word in (*words, *extra, *small, "--out", out)])


def test_everything_is_measured_and_printed(capture, tmp_path, capsys):
    lists = ("--sizes", 16, "--escapes", 0.1, "--bits", 12, "--keep", 0.6, "--qualities", 25, "--both", "0.5:25")
    parts = ("main", "control", "others", "sizes", "escapes", "positions", "sh0", "histogram", "curve")
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
    # What was tuned in memory, and files of it in either order, score the same.
    tuned = [steps[name]["psnr"] for name in ("+ fine-tuning", "+ entropy coding", "+ Morton order")]
    assert tuned == pytest.approx([row["after"]["psnr"]] * 3, abs=1e-5)
    assert steps["+ quantisation"]["psnr"] == pytest.approx(row["before"]["psnr"], abs=1e-5)
    assert row["after"]["psnr"] > row["before"]["psnr"]
    assert known["control"]["main"]["scores"]["trained on"]["psnr"] > 0.0
    assert 0.1 == pytest.approx(known["escapes"]["SH 10 %"]["sh_escapes"], abs=0.01)
    assert 181 == known["curve"]["keep 0.6"]["splats"]
    assert ["quality 25", "keep 0.6", "keep 0.5, quality 25"] == list(known["curve"])
    for title in ("Ablation", "Control", "Codebook sizes", "Thresholds", "Bits per axis", "Sensitivities", "Time"):
        assert title in printed
    with Image.open(tmp_path / "shell.png") as picture:
        assert (4 * W, H) == picture.size
    assert (tmp_path / "curve.png").exists()
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
        (("main", "--keep", "1.5"), "a share of splats is 1.5"),
        (("main", "--bits", "40"), "position_bits is 40"),
        (("main", "--sizes", "x"), "--sizes"),
        (("main", "--both", "0.5"), "--both"),
    ):
        with pytest.raises(SystemExit) as ended:
            run(capture, tmp_path / "out", *words)
        assert 2 == ended.value.code
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_peak_memory_is_that_of_the_command(capture, tmp_path):
    words = ["--data", str(capture), "--iterations", "3", "--threads", "1", "--force"]
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "compression_memory.py", capture / "scene.ply", "-o", tmp_path / "s.csplat",
         "--quiet", *words],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    found = json.loads(done.stdout)
    assert 1e7 < found["before_bytes"] < found["peak_bytes"] < 3e9
    assert (tmp_path / "s.csplat").exists()


def test_nothing_is_printed_of_what_is_not_known():
    assert "" == tables({})
    assert "" == tables({"half": {"settings": {}}})
