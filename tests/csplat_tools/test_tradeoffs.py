# SPDX-License-Identifier: Apache-2.0
"""`csplat tradeoff`: grids, failures, the Pareto front, the table, JSON, the page, and commands that repeat a row.

Also: csplat_tools.cli.tradeoff.
"""

import json
import re
import shlex
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from captures import photograph, shell
from command_line import call, hide_renderer
from models import with_facts

from csplat import EncodeOptions, InputError, Target
from csplat_tools import parse_formats, parse_grid, tradeoff
from csplat_tools.scene_files import load_scene
from csplat_tools.tradeoffs import Tradeoff, TradeoffRow, format_tradeoff, make_tradeoff_page, measure_grid
from csplat_tools.views import BLACK, ViewSet

GRID = {  # name: options of the encoder, target, words
    "presets=small": (EncodeOptions("small"), None, "--preset small"),
    "precision=36": (EncodeOptions("fast", 36.0), None, "--attribute-psnr 36 --preset fast"),
    "targets=.38e2": (EncodeOptions("fast"), Target(psnr=38.0), "--target-psnr .38e2 --preset fast"),
    "targets=1MB": (EncodeOptions("fast"), Target(size=10**6), "--target-size 1MB --preset fast"),
    "simplify=0.5": (EncodeOptions("fast"), Target(keep=0.5), "--keep 0.5 --preset fast"),
}


def test_a_grid_lists_settings():
    grid = parse_grid("presets=small, precision=36,targets=.38e2:1MB:1MB,simplify=0.5", "fast")
    assert GRID == {one.name: (one.options, one.target, " ".join(one.words)) for one in grid}
    assert {"presets": 3, "precision": 6, "targets": 3, "simplify": 3} == Counter(one.group for one in parse_grid())
    for text in (
        "", "presets,everything", "presets=3", "precision=forty", "precision=500", "precision=nan", "precision=36:",
        "targets=100", "targets=5 parsecs", "simplify=0", "simplify=1.5",
    ):  # fmt: skip
        with pytest.raises(InputError):
            parse_grid(text)


def test_other_formats_are_settings_with_all_their_presets():
    found = [(one.name, " ".join(one.words)) for one in parse_formats("spz, sog,spz")]
    assert [("spz", ""), ("spz=small", "--preset small"), ("sog", "")] == found
    for text in ("", "spz,xyz", "csplat", "ksplat", "precision=36"):
        with pytest.raises(InputError, match=r"is not another format, expected some of .*spz, .*sog"):
            parse_formats(text)


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_other_formats_are_scored_on_the_axes_and_at_the_origin_of_the_scene(make_model):
    model = make_model(60, 1)
    model = replace(model, shN=np.float32(0.2) * model.shN)  # SPZ clamps at 1
    tilted = with_facts(model, entries={"up": [0.6, 0.0, 0.8]})
    for scene in (replace(model, origin=(100.0, 0.0, 0.0)), with_facts(model, coordinate_system="LUB"), tilted):
        rows = tradeoff(scene, parse_formats("spz,sog,gltf")).rows
        assert {"spz", "spz=small", "sog", "gltf"} == {row.setting.name for row in rows}
        psnr = {row.setting.name: row.psnr for row in rows}
        assert 35 < psnr["spz=small"] < psnr["spz"] < psnr["gltf"]
        assert psnr["sog"] > 35


def row_of(setting, size_bytes=1000, psnr=40.0, images=None):
    scores = None if images is None else {"a": {"psnr": 33.0}, "b": {"psnr": images}}
    return TradeoffRow(setting, f"make '<{setting.name}>'", size_bytes, 9.0, 10, psnr, 0.99, scores, 1.5, 0.02)


def test_a_failure_does_not_stop_the_others():
    errors, said, done = {"40": InputError("too\nhigh"), "44": MemoryError()}, [], []

    def measure(setting):
        if setting.value in errors:
            raise errors[setting.value]
        return row_of(setting, 1000 * int(setting.value))

    grid = parse_grid("precision=48:40:44:36")
    rows, failures = measure_grid(grid, measure, said.append, lambda *now: done.append(now))
    assert ["36", "48"] == [one.setting.value for one in rows]
    assert {"precision=40": "too high", "precision=44": "out of memory"} == failures
    assert ["1/4 precision=48: 48.0 kB, 40.00 dB, 1.5 s", "2/4 precision=40: too high"] == said[:2]
    assert [0.0, 0.25, 0.5, 0.75] == [share for _, share in done]
    with pytest.raises(InputError, match="nothing could be measured; precision=40: too high; precision=44: out of"):
        measure_grid(grid[1:3], measure)
    errors["40"] = RuntimeError("a defect")
    with pytest.raises(RuntimeError, match="a defect"):
        measure_grid(grid, measure)


@pytest.fixture
def measured(make_model):
    """Return a function for made-up measurements: `measured((size, psnr), ..., images=PSNR)`."""

    def make(*points, images=None):
        source = load_scene(make_model(10)).changed(name="a & b.ply")
        grid = parse_grid(f"precision={':'.join(str(20 + number) for number in range(len(points)))}")
        rows = [row_of(setting, *point, images) for setting, point in zip(grid, points, strict=True)]
        return Tradeoff(source, ViewSet("lego", BLACK, (), (), ()), rows, {"targets=60": "out of <reach>"})

    return make


def test_table_and_json_have_all_rows_and_the_files_that_no_other_beats(measured):
    for points, front in (
        ([(10, 30.0)], [0]), ([(10, 30.0), (15, 35.0), (20, 40.0)], [0, 1, 2]), ([(10, 30.0), (20, 29.0)], [0]),
        ([(10, 30.0), (10, 31.0)], [1]), ([(10, 30.0), (20, 30.0)], [0]), ([(10, 30.0), (10, 30.0)], [0]),
    ):  # fmt: skip
        found = measured(*points)
        assert front == [found.rows.index(row) for row in found.front]
    found = measured((10_000, 30.0), (20_000, 29.0), images=31.5)
    title, _, _, first, second, *_, last = format_tradeoff(found).splitlines()
    assert "10 splats, SH degree 3" in title
    assert "the source itself has 33.00 dB" in title
    assert ["*", "precision=20", "10,000", "9.0", "30.00", "0.9900", "31.50"] == first.split()[:7]
    assert second.startswith("  precision=21")
    assert "not measured: targets=60: out of <reach>" == last
    report = json.loads(json.dumps(found.as_json()))
    assert ["precision=20"] == report["pareto"]
    assert (20_000, 31.5) == (report["points"][1]["size_bytes"], report["points"][1]["images"]["b"]["psnr"])
    assert "image PSNR" not in format_tradeoff(measured((10, 30.0)))


@pytest.mark.slow
def test_the_page_has_plots_and_commands_and_loads_nothing(measured):
    page = make_tradeoff_page(measured((10_000, 30.0), (2_000_000, 40.0), (3_000_000, 39.0), images=31.5))
    assert (3, 2) == (page.count("<svg"), page.count('<tr class="front">'))
    assert "<h1>a &amp; b.ply: size, quality and time</h1>" in page
    assert "<code>make &#x27;&lt;precision=20&gt;&#x27;</code>" in page
    assert "out of &lt;reach&gt;" in page
    assert {"http://www.w3.org/2000/svg"} == set(re.findall(r"[a-z]+://[^\"'\s<)]+", page))
    ids = re.findall(r'\bid="([^"]*)"', page)
    assert len(set(ids)) == len(ids)


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_a_row_agrees_with_its_command_and_with_compare(tmp_path, monkeypatch):
    folder = tmp_path / "my set"
    folder.mkdir()
    photograph(shell(3).select(slice(0, 100)), folder)
    monkeypatch.chdir(tmp_path)
    views = ("--data", "my set", "--json")
    words = ("--what", "presets=fast,targets=3kB", "--with", "spz", "--page", "page.html")
    done = call("tradeoff", "my set/scene.ply", *views, *words)
    assert "4/4 targets=3kB: " in done.stderr
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")
    rows = json.loads(done.stdout)["points"]
    assert {"presets=fast", "targets=3kB", "spz", "spz=small"} == {row["name"] for row in rows}
    assert min(row["size_bytes"] for row in rows) <= 3000
    for row in rows:
        _, *words = shlex.split(row["command"])
        call(*words, "--quiet")
        assert row["size_bytes"] == (tmp_path / words[2]).stat().st_size
        compared = json.loads(call("compare", *words[1:3], *views).stdout)
        for key in ("psnr", "ssim", "images"):
            assert compared[key] == row[key]


def test_wrong_words_and_missing_packages_are_refused_before_any_work(sample_path, tmp_path, make_model, monkeypatch):
    (tmp_path / "mine.html").write_text("mine")
    for status, words in (
        (2, ("--what", "presets=huge")), (2, ("--what", "presets", "--preset", "huge")), (2, ("--page", "-")),
        (2, ("--with", "spz,xyz")),
        (2, ("--data", "x", "--cameras", "y")), (1, ("--page", tmp_path / "mine.html")),
    ):  # fmt: skip
        call("tradeoff", sample_path, *words, status=status)
    with pytest.raises(InputError, match="the scene has no splats"):
        tradeoff(make_model(0))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    line = "error: this needs matplotlib, of the extra render: pip install matplotlib (E_INPUT)\n"
    assert line == call("tradeoff", sample_path, "--page", tmp_path / "report.html", status=1).stderr
    assert hide_renderer(monkeypatch) == call("tradeoff", sample_path, status=1).stderr
