"""`csplat tradeoff`: measurements, the Pareto front, the page, plots and commands, and errors."""

import hashlib
import html
import json
import re
import shlex
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from command_line import call, invoke

pytest.importorskip("numba", reason="requires the extra [render]")

from captures import cameras, photograph, shell
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from csplat import EncodeOptions, Target, decode, encode, write_ply
from csplat._spec import CHUNK_CODEBOOK
from csplat.decoder import read_header
from csplat.errors import InputError
from csplat.scene_source import drop_bands
from csplat_render.camera_files import save_cameras
from csplat_tools.study import Reduction
from csplat_tools.tradeoffs.sweep_options import USUAL, SweepOptions, parse_sweep, read_setting
from csplat_tools.tradeoffs.sweep_points import StageClock, SweepFailure, fetched_bytes, pareto_front
from csplat_tools.tradeoffs.sweep_run import plan_points, reduction_command, target_command, tradeoff
from csplat_tools.tradeoffs.tradeoff_report import (
    PLOTS,
    format_tradeoff,
    label_marks,
    make_tradeoff_page,
    shown_points,
    write_plots,
)
from csplat_tools.views import DataOptions, ViewSet
from csplat_tools.views.view_sets import pose_key

pytestmark = pytest.mark.usefixtures("small_views")

POINT = {
    "name", "family", "error", "command", "settings", "size_bytes", "sha256", "bytes_per_source_splat", "ratio",
    "splats", "sh_degree", "psnr", "psnr_mean", "psnr_worst", "worst_view", "ssim", "lpips", "photographs", "seconds",
    "render", "attribute_bytes", "first_picture_bytes", "partial",
}  # fmt: skip
QUICK = ["--what", "precision=36:40"]
SPLATS = 100  # the time of a sweep is proportional to it


def sweep(*words):
    return invoke("tradeoff", *words)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A scene, images of it, and cameras."""
    folder = photograph(shell(3).select(slice(0, SPLATS)), tmp_path_factory.mktemp("capture"))
    save_cameras(folder / "cameras.json", cameras(3))
    (folder / "a & b.ply").write_bytes((folder / "scene.ply").read_bytes())
    return folder


@pytest.fixture(scope="module")
def swept(capture, tmp_path_factory):
    """A sweep over every group but simplify, judged by photographs; one point cannot be made: no splat is so opaque."""
    folder = tmp_path_factory.mktemp("swept")
    made, check = [], ViewSet.__post_init__

    def keep(views):
        check(views)
        made.append(views)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ViewSet, "__post_init__", keep)
        patch.setattr("csplat_tools.cli.tradeoff.parse_sweep", partial(parse_sweep, iterations=5))
        result = sweep(
            capture / "a & b.ply", "--data", capture, "--what",
            "presets,precision=40,strategies=0.3:0.97:16,targets=3kB,finetune",
            "--preset", "fast", "-o", folder / "report.html", "--report", folder / "report.json",
        )  # fmt: skip
    assert 0 == result.exit_code, (result.stderr, result.exception)
    return folder, result, json.loads((folder / "report.json").read_text()), made


@pytest.fixture(scope="module")
def setting(capture):
    return read_setting(str(capture / "scene.ply"), cameras=str(capture / "cameras.json"))


@pytest.fixture(scope="module")
def measured(setting):
    return tradeoff(setting, SweepOptions(what=("presets", "precision"), attribute_psnr=(36.0,)))


# Measurements.
@pytest.mark.slow
def test_every_group_has_its_points(swept):
    _, _, report, _ = swept
    names = {one["name"]: one["family"] for one in report["points"]}
    assert {
        "fast": "presets", "balanced": "presets", "small": "presets", "attributes 40 dB": "precision",
        "SH 0": "strategies", "opacity > 0.3": "strategies", "opacity > 0.97": "strategies",
        "SH 0, opacity > 0.97": "strategies", "k-means 16": "strategies", "SH 0, distilled": "strategies",
        "target 3.0 kB": "targets", "tuned": "finetune", "tuned, keep 0.5": "finetune",
    } == names  # fmt: skip


@pytest.mark.slow
def test_the_json_describes_each_point(swept):
    _, _, report, _ = swept
    assert {"scene", "views", "machine", "times", "source", "pareto", "pareto_photographs", "points"} == set(report)
    for point in report["points"]:
        if point["error"] is None:
            assert set(point) == POINT
            assert sum(point["attribute_bytes"].values()) == point["size_bytes"]
            assert {"standard", "fast"} == set(point["render"])
            assert point["photographs"]["views"] == report["views"]["count"]
    assert report["machine"]["cores"] >= 1
    assert "numpy" in report["machine"]["packages"]


@pytest.mark.slow
def test_a_failed_point_is_reported_and_the_others_are_measured(swept):
    folder, result, report, _ = swept
    failed = [one for one in report["points"] if one["error"] is not None]
    assert ["opacity > 0.97", "SH 0, opacity > 0.97"] == [one["name"] for one in failed]
    assert "no splat has an opacity above 0.97" in failed[0]["error"]
    assert "not measured: opacity > 0.97: no splat has an opacity above 0.97" in result.stdout
    assert "no splat has an opacity above 0.97" in (folder / "report.html").read_text()


@pytest.mark.slow
def test_targets_are_reached(swept):
    _, _, report, _ = swept
    points = {one["name"]: one for one in report["points"]}
    assert points["target 3.0 kB"]["size_bytes"] <= 3000
    assert {"goal", "chosen"} <= set(points["target 3.0 kB"]["settings"]["target"])


@pytest.mark.slow
def test_rows_name_the_target_of_their_search(setting, monkeypatch):
    asked = []

    def fail(source, options, **words):
        asked.append((source, options, words))
        raise InputError("none")

    monkeypatch.setattr("csplat_tools.tradeoffs.sweep_run.encode_with_report", fail)
    wanted = SweepOptions(what=("targets", "simplify"), preset="fast", psnr=(30.0,), sizes=(9000,), keep=(0.7,))
    tried = {one.name: one for one in plan_points(setting, wanted)}
    for name, target in (
        ("target 30 dB", Target(psnr=30.0)), ("target 9.0 kB", Target(size_bytes=9000)), ("keep 0.7", Target(keep=0.7)),
    ):  # fmt: skip
        assert ("targets" if target.keep is None else "simplify") == tried[name].family
        with pytest.raises(InputError, match="none"):
            tried[name].make(lambda *_: None)
        source, options, words = asked.pop()
        assert source is setting.source
        assert words["views"] is setting.views
        assert "fast" == options.preset
        assert target == words["target"]


def roles_of(views):
    return views.training, views.validation, views.test


@pytest.mark.slow
def test_test_views_choose_no_file(swept):
    *_, made = swept
    assert len(made) > 1  # fine-tuning has views of its own
    for views in made:
        roles = [{pose_key(camera) for camera in role} for role in roles_of(views)]
        assert sum(map(len, roles)) == len(set.union(*roles))
        seen = [[int(camera.image[-6:-4]) for camera in role if camera.image] for role in roles_of(views)]
        assert not {0, 8} & {*seen[0], *seen[1]}
        assert seen[2] in ([0, 8], [])
    assert any(views.test and views.training for views in made)


@pytest.mark.slow
def test_tuned_files_have_the_requested_splats(swept):
    _, _, report, _ = swept
    points = {one["name"]: one for one in report["points"]}
    assert SPLATS / 2 == points["tuned, keep 0.5"]["splats"]
    assert SPLATS + 1 == report["scene"]["splats"]
    assert SPLATS == points["tuned"]["splats"]  # one splat is in no image
    assert {"choosing", "encoding", "tuning"} == set(points["tuned"]["seconds"]["stages"])


@pytest.mark.slow
def test_numbers_agree_with_compare(capture, swept, tmp_path):
    _, _, report, _ = swept
    point = next(one for one in report["points"] if one["name"] == "small")
    path = tmp_path / "small.csplat"
    call("encode", capture / "scene.ply", path, "--preset", "small", "--quiet")
    assert path.stat().st_size == point["size_bytes"]
    compared = json.loads(call("compare", capture / "scene.ply", path, "--data", capture, "--json").stdout)
    for name in ("psnr", "psnr_mean", "psnr_worst", "worst_view", "ssim"):
        assert compared[name] == point[name]
    assert compared["photographs"]["b"]["psnr"] == point["photographs"]["psnr"]
    assert compared["photographs"]["a"]["psnr"] == report["source"]["photographs"]["psnr"]
    assert compared["ratio"] == point["ratio"]


@pytest.mark.slow
def test_the_same_scene_gives_the_same_files_and_numbers(setting, measured):
    again = tradeoff(setting, measured.sweep).as_json()
    assert timeless(measured.as_json()) == timeless(again)


def timeless(value):
    if isinstance(value, dict):
        times = {"seconds", "ms", "render_ms", "decode_seconds"}
        return {key: timeless(one) for key, one in value.items() if key not in times}
    return [timeless(one) for one in value] if isinstance(value, list) else value


@pytest.mark.slow
def test_fewer_layers_have_fewer_bytes_and_a_lower_psnr(measured):
    for point in measured.measured:
        assert (len(point.partial) == 2) == (point.family == "presets")
        for fewer, more in zip(point.partial, point.partial[1:], strict=False):
            assert fewer.size_bytes < more.size_bytes <= point.size_bytes
            assert fewer.quality.psnr < more.quality.psnr
        if point.partial:
            assert point.first_picture_bytes == point.partial[0].size_bytes
            assert point.psnr == point.partial[-1].quality.psnr


def test_fetched_bytes_suffice():
    data = bytearray(encode(shell(15), EncodeOptions(preset="fast", tile_splats=100)))
    header, wanted = read_header(bytes(data)), decode(bytes(data), sh_degree=1)
    kept = len(data)
    for tile in header.tiles:
        for layer, record in tile.layers.items():
            if layer > 1:
                data[record.offset : record.offset + record.size] = bytes(record.size)
                kept -= record.size
    for chunk in header.directory:  # the file has no codebooks, so these chunks describe the whole file
        data[chunk.offset + 8 : chunk.offset + chunk.size] = bytes(chunk.size - 8)
        kept -= chunk.size
    assert fetched_bytes(header, 1) == kept
    np.testing.assert_array_equal(wanted.shN, decode(bytes(data), sh_degree=1).shN)


def test_codebooks_are_fetched_with_their_layers():
    options = EncodeOptions(sh_coding="codebook", codebook_size=16)
    header = read_header(encode(shell(15), options))
    books = [chunk for chunk in header.directory if chunk.type == CHUNK_CODEBOOK]
    others = sum(chunk.size for chunk in header.directory) - sum(chunk.size for chunk in books)
    assert {1, 2, 3} == {chunk.layer for chunk in books}
    assert header.file_size - others == fetched_bytes(header, 3)
    third = sum(tile.layers[3].size for tile in header.tiles) + sum(one.size for one in books if one.layer == 3)
    assert third == fetched_bytes(header, 3) - fetched_bytes(header, 2)


def test_stages_are_timed_by_their_names():
    now, heard = iter([0.0, 1.0, 3.0, 3.5, 4.5, 9.0]), []
    clock = StageClock(clock=lambda: next(now))
    report = clock.listening(lambda stage, done: heard.append((stage, done)))
    for stage, done in (("codebook", 0.0), ("codebook", 0.5), ("codebook", 1.0), ("tiles", 0.2), ("tiles", 1.0)):
        report(stage, done)
    assert [("codebook", 0.0), ("codebook", 0.5), ("codebook", 1.0), ("tiles", 0.2), ("tiles", 1.0)] == heard
    assert {"codebook": 2.5, "tiles": 5.5} == clock.seconds


# The Pareto front.
FRONTS = (
    ([], []), ([(10, 30.0)], [0]), ([(10, 30.0), (20, 40.0), (15, 35.0)], [0, 2, 1]), ([(10, 30.0), (20, 29.0)], [0]),
    ([(10, 30.0), (10, 31.0)], [1]), ([(10, 30.0), (20, 30.0)], [0]), ([(10, 30.0), (10, 30.0)], [0]),
    ([(30, 50.0), (20, 45.0), (25, 40.0), (10, 20.0)], [3, 1, 0]),
)  # fmt: skip


def test_the_front_consists_of_files_that_no_other_beats():
    assert [front for _, front in FRONTS] == [pareto_front(points) for points, _ in FRONTS]


@pytest.mark.slow
def test_the_front_is_marked_in_the_table(swept):
    _, result, report, _ = swept
    points = {one["name"]: one for one in report["points"] if one["error"] is None}
    front = set()
    for name, one in points.items():
        others = [other for other in points.values() if other["size_bytes"] <= one["size_bytes"] and other is not one]
        if all(other["psnr"] < one["psnr"] for other in others):
            front.add(name)
    assert front == set(report["pareto"])
    table = result.stdout.split("\n\n")[1].splitlines()[1:-1]
    assert front == {re.split(r"\s{2,}", line[2:])[0] for line in table if line.startswith("* ")}
    sizes = [int(re.split(r"\s{2,}", line[2:])[1]) for line in table]
    assert sorted(sizes) == sizes
    assert len(points) == len(sizes)


# The page and the plots.
@pytest.mark.slow
def test_the_page_has_no_external_references(swept):
    text = (swept[0] / "report.html").read_text()
    assert {"data:image/webp;base64", "#"} == {
        value.split(",")[0] if value.startswith("data:") else value[0]
        for value in re.findall(r'(?:src|href|action|srcset)="([^"]*)"', text)
    }
    addresses = set(re.findall(r"[a-z]+://[^\"'\s<)]+", text))
    assert addresses == {"http://www.w3.org/2000/svg"}  # a namespace
    assert "default-src 'none'" in text
    assert ' style="' not in text
    assert "@import" not in text
    assert re.findall(r"url\((?!#)", text) == []
    assert len(text) < 4_000_000


@pytest.mark.slow
def test_ids_of_the_page_are_unique(swept):
    text = (swept[0] / "report.html").read_text()
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(set(ids)) == len(ids) > 100
    used = set(re.findall(r'href="#([^"]*)"', text)) | set(re.findall(r"url\(#([^)]*)\)", text))
    assert used <= set(ids)


@pytest.mark.slow
def test_images_show_presets_and_the_front(measured):
    shown = [one.name for one in shown_points(measured)]
    assert {"fast", "balanced", "small"} <= set(shown)
    assert set(shown) <= {"fast", "balanced", "small"} | {one.name for one in measured.front}


@pytest.mark.slow
def test_plots_with_data_are_shown(swept, measured):
    assert len(PLOTS) == (swept[0] / "report.html").read_text().count('<figure class="plot">')
    assert PLOTS["size-photographs"](measured, "size-photographs", False) is None


@pytest.mark.slow
def test_plots_of_a_page_use_its_colours(swept):
    inside = re.findall(r"<svg.*?</svg>", (swept[0] / "report.html").read_text(), re.DOTALL)
    assert len(PLOTS) == len(inside)
    assert [] == [one for one in inside if "<style" in one or "#123457" in one]


@pytest.mark.slow
def test_plots_are_deterministic(measured):
    assert PLOTS["sh-layers"](measured, "sh-layers", True) == PLOTS["sh-layers"](measured, "sh-layers", True)


@pytest.mark.slow
def test_names_of_scenes_are_escaped(swept):
    text = (swept[0] / "report.html").read_text()
    assert "a & b" not in text
    assert "<h1>a &amp; b.ply: size, quality and time</h1>" in text


@pytest.mark.slow
def test_the_table_of_the_page_sorts_and_copies_commands(tab, swept):
    tab.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    tab.page.goto((swept[0] / "report.html").as_uri())
    assert "a & b.ply: size, quality and time" == tab.page.title()
    names = "[...document.querySelectorAll('.sortable tbody tr')].map((row) => row.cells[{}].dataset.value)"
    sizes = [int(value) for value in tab.page.evaluate(names.format(3))]
    assert sorted(sizes) == sizes
    for _ in range(2):
        tab.page.click(".sortable th:nth-child(4) button")
    assert sizes[::-1] == [int(value) for value in tab.page.evaluate(names.format(3))]
    tab.page.click(".sortable th:nth-child(1) button")
    sorted_names = tab.page.evaluate(names.format(0))
    assert sorted(sorted_names, key=str.casefold) == sorted_names
    broken = "[...document.images].filter((one) => !one.naturalWidth).length"
    assert 0 == tab.page.evaluate(broken)
    coloured = "getComputedStyle(document.querySelector('.plot use[fill^=\"#\"]')).fill"
    assert tab.page.evaluate(coloured).startswith("rgb")

    row = tab.page.locator(".sortable tbody tr").filter(has=tab.page.get_by_role("cell", name="SH 0", exact=True))
    row.locator("button").click()
    tab.until("document.querySelector('.sortable').textContent.includes('copied')")
    command = next(one["command"] for one in swept[2]["points"] if one["name"] == "SH 0")
    assert command == tab.page.evaluate("navigator.clipboard.readText()")


@pytest.mark.slow
def test_the_page_explains_every_heading_and_shows_every_command(swept):
    text = html.unescape((swept[0] / "report.html").read_text())
    heads = re.findall(r'<th scope="col" title="([^"]+)"><button type="button">([^<]+)<', text)
    assert len(heads) > 12
    for hint, title in heads:
        assert f"<dt>{title}</dt> <dd>{hint}</dd>" in text
    for point in swept[2]["points"]:
        if point["error"] is None:
            assert f">{point['command']}</code>" in text


@pytest.mark.parametrize("count", [10, 30])
def test_labels_of_a_plot_do_not_overlap(count):
    figure = Figure(figsize=(7.0, 4.4), dpi=100)
    axes = figure.add_subplot()
    rng = np.random.default_rng(count)
    sizes = np.sort(rng.lognormal(0.0, 0.4, count))
    marks = [(float(x), float(30.0 + 8.0 * np.log(x) + y)) for x, y in zip(sizes, rng.normal(0, 2, count), strict=True)]
    axes.plot(*zip(*marks, strict=True), "o")
    names = [f"attributes {number} dB" for number in range(count)]
    numbered = label_marks(axes, marks, names, [str(number) for number in range(count)], [marks[:5]])
    assert (count == 30) == numbered
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = canvas.get_renderer()
    boxes = [Text.get_window_extent(text, drawn) for text in axes.texts]  # without lines to the marks
    assert count == len(boxes)
    for place, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:place])
        assert not any(box.contains(*axes.transData.transform(mark)) for mark in marks)
        assert axes.bbox.contains(box.x0, box.y0)
        assert axes.bbox.contains(box.x1, box.y1)


# Commands of rows.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["fast", "attributes 40 dB", "SH 0", "SH 0, distilled", "k-means 16", "target 3.0 kB"])
def test_the_command_of_a_row_gives_its_bytes(swept, tmp_path, monkeypatch, name):
    point = next(one for one in swept[2]["points"] if one["name"] == name)
    monkeypatch.chdir(tmp_path)
    program, *words = shlex.split(point["command"])
    if program == "csplat":
        call(*words, "--quiet")
    else:
        assert ["python", "-c"] == [program, words[0]]
        exec(compile(words[1], "command", "exec"), {})  # noqa: S102 -- the test runs the command of the page
    (made,) = tmp_path.iterdir()
    assert point["sha256"] == hashlib.sha256(made.read_bytes()).hexdigest()


@pytest.mark.slow
def test_commands_are_quoted_for_a_shell(setting):
    told = replace(
        setting, path="my scenes/it's.ply", cameras="$HOME/cams.json", background=(0.1, 0.0, 1.0),
        data=DataOptions('a "set"', (480, 270), None, 5),
    )  # fmt: skip
    plain = replace(told, data=DataOptions('a "set"', images="images_4"))
    assert "" == target_command(told, "target 2.0 MB", "small", target_size=2_000_000)
    words = shlex.split(target_command(plain, "target 2.0 MB", "small", target_size=2_000_000))
    assert [
        "csplat", "encode", "my scenes/it's.ply", "it's-target-2.0-MB.csplat", "--target-size", "2000000", "--preset",
        "small", "--cameras", "$HOME/cams.json", "--data", 'a "set"/images_4', "--background", "0.1,0.0,1.0",
    ] == words  # fmt: skip
    *_, program = shlex.split(reduction_command(told, "SH 0, distilled", "small", Reduction(sh_degree=0, distil=True)))
    compile(program, "command", "exec")
    assert r'data=DataOptions("a \"set\"", (480, 270), None, 5), background=(0.1, 0.0, 1.0)' in program


# Errors.
def test_a_sweep_without_any_point_fails(setting):
    wanted = SweepOptions(what=("strategies",), opacities=(0.99,), kmeans=())
    with pytest.raises(InputError, match=r"no point could be measured; opacity > 0.99: no splat"):
        tradeoff(replace(setting, source=drop_bands(setting.source, 0)), wanted)


@pytest.mark.slow
def test_a_scene_without_splats_is_swept(setting, make_model, monkeypatch):
    empty = replace(setting, source=make_model(0, 1), source_bytes=1000)
    found = tradeoff(empty, SweepOptions(what=("presets",)))
    assert [None] * 3 == [one.bytes_per_source_splat for one in found.measured]
    assert {99.0} == {one.psnr for one in found.measured}
    assert "0 splats" in format_tradeoff(found)
    assert "<svg" in PLOTS["size-quality"](replace(found, points=found.points[:1]), "size-quality", False)
    for name in PLOTS:
        monkeypatch.setitem(PLOTS, name, lambda *_: None)  # drawing takes a second
    assert make_tradeoff_page(found).startswith("<!doctype html>")


def test_a_bug_is_not_reported_as_a_failed_point(setting, monkeypatch):
    def fail(*_args, **_options):
        raise RuntimeError("a defect")

    monkeypatch.setattr("csplat_tools.tradeoffs.sweep_run.encode_with_report", fail)
    with pytest.raises(RuntimeError, match="a defect"):
        tradeoff(setting, SweepOptions(what=("presets",)))


def test_a_lack_of_memory_fails_one_point(setting, monkeypatch):
    from csplat_tools.tradeoffs import sweep_run

    whole = sweep_run.encode_with_report

    def fail(model, options, **others):
        if options.preset == "small":
            raise MemoryError
        return whole(model, options, **others)

    monkeypatch.setattr(sweep_run, "encode_with_report", fail)
    found = tradeoff(setting, SweepOptions(what=("presets",)))
    assert [SweepFailure("small", "presets", "out of memory")] == found.failures


@pytest.mark.slow
def test_files_are_not_replaced_without_force(capture, tmp_path):
    mine = {"-o": tmp_path / "page", "--report": tmp_path / "report"}
    words = [capture / "scene.ply", "--what", "precision=40", "--cameras", capture / "cameras.json", "--quiet"]
    for option, place in mine.items():
        place.write_text("mine")
        refused = sweep(*words, option, place)
        assert 1 == refused.exit_code
        assert re.fullmatch(r"error: \S+ exists: --force replaces it \(E_INPUT\)\n", refused.stderr)
        assert "mine" == place.read_text()
    done = sweep(*words, "--report", mine["--report"], "--force")
    assert (0, "") == (done.exit_code, done.stderr)
    assert "Times are single runs" in done.stdout
    assert "mine" != mine["--report"].read_text()


@pytest.mark.slow
def test_plots_are_written_for_light_and_dark_pages(measured, tmp_path, monkeypatch):
    plots = {name: PLOTS[name] for name in ("size-quality", "attribute-bytes", "sh-layers")}  # one of each kind
    monkeypatch.setattr("csplat_tools.tradeoffs.tradeoff_report.PLOTS", plots)
    write_plots(str(tmp_path / "plots"), measured)
    with pytest.raises(InputError, match="exists: --force replaces it"):
        write_plots(str(tmp_path / "plots"), measured)
    written = {path.stem: path.read_text() for path in (tmp_path / "plots").iterdir()}
    assert {"size-quality", "attribute-bytes"} <= set(written)
    for text in written.values():  # light or dark by the reader's setting
        assert "prefers-color-scheme:dark" in text
        assert "currentColor" in text
        assert "#123457" not in text


@pytest.mark.slow
def test_json_goes_to_stdout_and_progress_to_stderr(capture):
    result = sweep(capture / "scene.ply", *QUICK, "--cameras", capture / "cameras.json", "--json")
    assert ["attributes 36 dB", "attributes 40 dB"] == [one["name"] for one in json.loads(result.stdout)["points"]]
    assert "2 files to make and measure: about" in result.stderr
    assert re.search(r"1/2 attributes 36 dB: [\d.]+ kB, [\d.]+ dB, [\d.]+ s\n", result.stderr)


def test_an_absent_file_is_reported(tmp_path):
    result = sweep(tmp_path / "absent.ply")
    message = f"error: {tmp_path / 'absent.ply'}: No such file or directory; is the name right? (ENOENT)\n"
    assert (1, message) == (result.exit_code, result.stderr)


def test_a_scene_without_splats_is_refused(tmp_path, make_model):
    write_ply(tmp_path / "empty.ply", make_model(0))
    result = sweep(tmp_path / "empty.ply", "-o", tmp_path / "report.html")
    assert 1 == result.exit_code
    assert "error: the scene has no splats (E_INPUT)\n" == result.stderr
    assert not (tmp_path / "report.html").exists()


WRONG = (
    ["--what", "presets,everything"], ["--what", ""], ["--what", "strategies", "--preset", "huge"],
    ["--what", "precision=forty"], ["--what", "precision=500"], ["--what", "presets=3"],
    ["--what", "precision=36,precision=44"], ["--what", "targets=100"], ["--what", "targets=5 parsecs"],
    ["--what", "simplify=0"], ["--what", "simplify=1.5"], ["--what", "strategies=nan"], ["--what", "strategies=70000"],
    ["--data", "x", "--cameras", "y"], ["--plots", "x"], ["-o", "-"],
)  # fmt: skip


def test_a_wrong_command_line_has_status_2(capture):
    statuses = {" ".join(words): sweep(capture / "scene.ply", *words).exit_code for words in WRONG}
    assert {} == {words: status for words, status in statuses.items() if status != 2}


def test_the_list_of_a_sweep_is_parsed():
    assert ("targets", "presets") == parse_sweep("targets,presets,targets").what
    assert (*USUAL, "finetune") == parse_sweep("usual, finetune").what
    wanted = parse_sweep("targets=38:2MB:.5e2:38, strategies=0.1:16:256, precision=")
    assert ((38.0, 50.0), (2_000_000,)) == (wanted.psnr, wanted.sizes)
    assert ((0.1,), (16.0, 256.0)) == (wanted.opacities, wanted.kmeans)
    assert () == wanted.attribute_psnr


@pytest.mark.parametrize(("module", "words"), [("numba", []), ("matplotlib", ["-o", "report.html"])])
def test_missing_packages_are_named(tmp_path, sample_path, monkeypatch, module, words):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(tmp_path)
    done = sweep(sample_path, *words)
    assert 1 == done.exit_code
    assert f"error: this needs {module}: pip install 'csplat[render]' (E_INPUT)\n" == done.stderr


def test_the_help_has_examples():
    text = sweep("--help").stdout
    assert "csplat tradeoff scene.ply -o report.html" in text
