# SPDX-License-Identifier: Apache-2.0
"""Levels of detail: cuts through the nodes, reading, copying and encoding them, and the first builder.

Also: csplat.decoder.tree, csplat_tools.level_errors.
"""

import io
import json
import math
import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from command_line import call, hide_renderer, invoke
from hypothesis import given, settings
from hypothesis import strategies as st

import csplat
from csplat import Context, InputError, LimitError, _spec, decode, decode_scene, read_header
from csplat.decoder.container import SceneHeader
from csplat.decoder.tree import Node, select_tiles
from csplat.encoder import EncodeOptions, EncodePlan
from csplat.encoder.levels import LevelNode, encode_levels
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import all_inputs
from csplat_conformance.encoders.file_checks import SplatPairs
from csplat_conformance.encoders.render_checks import check_renders
from csplat_conformance.manifest import VECTORS, load
from csplat_conformance.validator import validate
from csplat_render.camera_files import save_cameras
from csplat_render.camera_paths import orbit_cameras
from csplat_render.first_view import viewing_metadata
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.cli.shared_options import parse_level
from csplat_tools.convert_file import convert_file
from csplat_tools.encode_file import encode_file
from csplat_tools.level_builder import FittedLevelBuilder, choose_levels, kd_groups
from csplat_tools.level_merging import merge_neighbours
from csplat_tools.scene_files import load_scene
from csplat_tools.views import find_view_set

pytestmark = pytest.mark.usefixtures("little_level_work")

TREE = VECTORS / "valid" / "levels_of_a_tree.csplat"
RICH = VECTORS / "valid" / "levels_of_the_rich_scene.csplat"
NOTHING = next(VECTORS / one.file for one in load() if one.expect and one.expect["header"]["tile_count"] == 0)
SPLATS = 400
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@pytest.fixture(scope="module")
def model(sample_path):
    return csplat.read(sample_path).select(slice(0, SPLATS))


@pytest.fixture(scope="module")
def data(model):
    """A file of four leaves in two levels above, with errors that grow."""
    leaves = kd_groups(model.means, 4)
    halves = [quarter(model.select(np.concatenate(leaves[at : at + 2]))) for at in (0, 2)]
    nodes = [LevelNode(0, 4 + number // 2, rows=rows) for number, rows in enumerate(leaves)]
    nodes += [LevelNode(1, 6, splats=half, error=error) for half, error in zip(halves, (0.5, 0.25), strict=True)]
    nodes.append(LevelNode(2, None, splats=quarter(halves[0]), error=1.0))
    return encode_levels(EncodePlan.of(model), nodes).write().data


@pytest.fixture
def path(data, tmp_path):
    (tmp_path / "levels.csplat").write_bytes(data)
    return tmp_path / "levels.csplat"


def test_levels_report_the_whole_of_their_work(model):
    reports = []
    csplat.encode(model, levels=2, context=Context(progress=lambda stage, done: reports.append((stage, done))))
    words, fractions = zip(*reports, strict=True)
    assert {"levels"} == {text.partition(": ")[0] for text in words}
    assert (0.0, 1.0) == (fractions[0], fractions[-1])
    fitted = [text for text in dict.fromkeys(words) if "refitting" in text]
    assert [f"levels: refitting splats of level {level}" for level in (1, 2)] == fitted
    merged = []
    builder, context = FittedLevelBuilder(2, fits=False), Context(progress=lambda stage, _: merged.append(stage))
    csplat.encode(model, levels=builder, context=context)
    assert {f"levels: merging splats of level {level}" for level in (1, 2)} < set(merged)


def test_the_time_of_levels_is_the_measured_one_within_half():
    # Seconds on two cores: lego60k, fox120k, garden500k, and a capture of 1,136,356 splats.
    measured = {60_000: (1.1, 24.4), 120_000: (2.6, 44.5), 500_000: (10.7, 86.0), 1_136_356: (27.4, 145.3)}
    for count, times in measured.items():
        for fits, seconds in zip((False, True), times, strict=True):
            assert 1 / 1.5 < FittedLevelBuilder(fits=fits).seconds(count, 2) / seconds < 1.5


def quarter(splats, neighbours=8):
    return merge_neighbours(splats, np.zeros(len(splats), np.int64), math.ceil(len(splats) / 4), neighbours)[1]


def same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


def counts_by_level(data, levels):
    with csplat.open(data) as file:
        return [len(file.read(tiles=file.cut(level=level))) for level in levels]


def assert_valid(data):
    assert () == tuple(validate(data).violations)


@st.composite
def trees(draw):
    """Draw nodes of any shape; node k has tile k, of k + 1 splats for a leaf."""
    like, nodes = read_header(TREE).tiles[0], []
    levels = [0] * draw(st.integers(1, 6)) + sorted(draw(st.lists(st.integers(1, 4), max_size=6)))
    for level in levels:
        at, free = len(nodes), [k for k, node in enumerate(nodes) if node.parent is None and node.level < level]
        if level and not free:
            continue
        below = tuple(sorted(draw(st.sets(st.sampled_from(free), min_size=1)))) if level else ()
        for child in below:
            nodes[child] = replace(nodes[child], parent=at)
        tile = replace(like, index=at, level=level, corner=(draw(st.integers(-50, 50)), 0, 0), extent=(3, 3, 3))
        splats = draw(st.integers(1, sum(nodes[child].splat_count for child in below))) if level else at + 1
        error = max(nodes[child].error for child in below) + draw(st.sampled_from([0.0, 0.5, 1.0])) if level else 0.0
        nodes.append(Node((tile,), None, below, level, splats, error))
    return nodes


def header_of(nodes) -> SceneHeader:
    tiles = [node.tiles[0] for node in nodes]
    split = sum(tile.level == 0 for tile in tiles)
    return replace(read_header(TREE), tiles=tuple(tiles[:split]), coarse_tiles=tuple(tiles[split:]))


@pytest.mark.slow
@settings(max_examples=40)
@given(nodes=trees(), level=st.integers(0, 5), budget=st.integers(0, 40), seed=st.integers(0, 9))
def test_cuts_are_those_of_the_pseudo_code(spec, nodes, level, budget, seed):
    header = header_of(nodes)
    plain = [replace(node, parent=_spec.NO_PARENT if node.parent is None else node.parent) for node in nodes]
    sizes = np.random.default_rng(seed).choice([0.0, 0.25, 0.5, 1.0, math.inf], len(nodes)).tolist()

    def selected(**what):
        return [tile.index for tile in select_tiles(header, nodes, **what)]

    assert spec.cut_at_level(plain, level) == selected(level=level)
    assert spec.cut_at_pixel_size(plain, sizes) == selected(pixel_size=sizes)
    expected = spec.cut_within(plain, budget)
    if expected is None:
        with pytest.raises(LimitError, match="max_splats: needs"):
            selected(max_splats=budget)
    else:
        assert expected == selected(max_splats=budget)


@pytest.mark.slow
@settings(max_examples=40)
@given(nodes=trees(), level=st.integers(0, 5), low=st.floats(-0.06, 0.06), near=st.integers(-2, 2), data=st.data())
def test_the_tiles_of_a_box_are_those_of_the_pseudo_code(spec, nodes, level, low, near, data):
    header = header_of(nodes)
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step

    def boxed(number, low, high, **more):
        return SimpleNamespace(number=number, low=low, high=high, level=nodes[number].level, **more)

    def corner(integers):
        return [float(np.float32(float(n) * step)) for n in integers]

    plain = []
    for number, node in enumerate(nodes):  # with one tile each
        tile = node.tiles[0]
        own = boxed(number, corner(tile.corner), corner(np.add(tile.corner, tile.extent)))
        below = [own, *(plain[child] for child in node.children)]
        lows, highs = ([*zip(*ends, strict=True)] for ends in ([b.low for b in below], [b.high for b in below]))
        plain.append(boxed(number, [*map(min, lows)], [*map(max, highs)], tiles=[own]))
    sides = [side for one in plain for side in (one.low[0], one.high[0])]
    edge = data.draw(st.sampled_from([low, *sides]))  # and the numbers next to a side
    for _ in range(abs(near)):
        edge = math.nextafter(edge, math.copysign(math.inf, near))
    whole = [tile.index for tile in select_tiles(header, nodes, level=level)]
    for box in ([[edge, -9, -9], [math.inf, 9, 9]], [[-math.inf, -9, -9], [edge, 9, 9]]):
        part = [tile.index for tile in select_tiles(header, nodes, level=level, box=np.array(box))]
        assert spec.tiles_in_box(plain, whole, SimpleNamespace(low=box[0], high=box[1])) == part


def test_refuses_arguments_of_a_cut():
    exclusive, numbers = {"level": 1, "max_splats": 9}, "expected six numbers other than NaN"
    boxes = ((0, 0, 0, 1, 1, math.nan), ((0, 0, 0), (1, 1, 1)), "000111x", 1.0, (10**400, 0, 0, 1, 1, 1))
    with csplat.open(TREE) as file:
        for what, message in (
            (exclusive, "level and max_splats exclude each other"), ({"level": -1}, "level is -1, expected 0 to 255"),
            ({"level": 256}, "level is 256, expected 0 to 255"), ({"max_splats": -1}, "max_splats is -1, expected 0"),
            ({"pixel_size": -0.5}, "pixel_size is -0.5, expected 0 or more"),
            ({"pixel_size": math.nan}, "pixel_size is nan, expected 0 or more"),
            ({"pixel_size": [1.0, 2.0]}, "pixel_size has 2 numbers, expected one, or one for each of 13 nodes"),
            ({"box": (1, 2, 3)}, r"box is \(1, 2, 3\), " + numbers), *(({"box": box}, numbers) for box in boxes),
            ({"box": (9e9, 0, 0, 9e9, 1, 1)}, "no tile touches the box"),
        ):  # fmt: skip
            with pytest.raises(InputError, match=message):
                file.cut(**what)


def test_a_file_without_levels_is_one_node_and_coarser_levels_have_no_extra_columns():
    with csplat.open(VECTORS / "valid" / "two_tiles.csplat") as file:
        assert [0, 1] == file.cut() == file.cut(level=3) == file.cut(pixel_size=9.0) == file.cut(max_splats=5)
        with pytest.raises(LimitError, match="max_splats: needs 5, allowed 4"):
            file.cut(max_splats=4)
    with csplat.open(NOTHING) as file:
        assert ((), []) == (file.nodes, file.cut(max_splats=0))
    with csplat.open(RICH, max_splats=read_header(RICH).splat_count - 1) as scene:
        assert [{}] == [block.extra for block in scene.blocks()]
    with csplat.open(RICH) as file:
        assert [{}, {}] == [file.read(tiles=tiles).extra for tiles in (file.cut(level=1), [0, 2])]
        assert [["label"], ["label"]] == [list(file.read(**what).extra) for what in ({}, {"tiles": [0]})]


@pytest.mark.slow
def test_the_default_is_level_0_and_a_cut_has_the_values_of_its_tiles(data, model, path):
    header, whole = read_header(data), decode(data)
    assert len(model) == header.splat_count < sum(tile.splat_count for tile in header.all_tiles)
    assert same(whole, csplat.read(path))
    with csplat.open(path) as file:
        assert same(whole, file.read())
        assert same(whole, file.read(tiles=file.cut()))
        assert len(header.tiles) == len(list(file.tiles())) == len(file.boxes)
        tiles = file.cut(level=1)
        assert {1} == {header.all_tiles[index].level for index in tiles}
        coarse, parts = file.read(tiles=tiles), [decode(data, tiles=[index]) for index in tiles]
        for name in ARRAYS:
            assert np.array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(coarse, name))
        assert all(len(decode(data, tiles=file.cut(max_splats=most))) <= most for most in (50, 100, 230, SPLATS))


def test_a_cut_reads_its_part_of_a_file(data):
    with csplat.open(data) as file:
        (coarsest,) = file.cut(level=2)
        before, tiles = file.bytes_read, file.header.all_tiles
        file.read(tiles=[coarsest])
        assert file.bytes_read - before < len(data) / 2
        first = tiles[coarsest].layers[0].offset
        assert _spec.HEADER_SIZE + file.header.index_size == file.header.chunk(_spec.CHUNK_TREE).offset < first
    assert all(first < tile.layers[0].offset for tile in tiles if tile.index != coarsest)


def test_levels_of_a_file_are_scenes_to_convert_and_listed_by_info(data, path, tmp_path):
    said = call("convert", path, tmp_path / "coarse.ply", "--level", 1).stderr
    assert "2 coarser levels of detail: level 1 alone is read" in said
    assert counts_by_level(data, [1]) == [len(csplat.read(tmp_path / "coarse.ply"))]
    refused = call("convert", path, tmp_path / "coarse.ply", "--level", 3, "--force", status=1)
    assert "the level is 3, expected 0 to 2" in refused.stderr
    levels = json.loads(call("info", path, "--json").stdout)["levels"]
    assert [(0, 4), (1, 2), (2, 1)] == [(one["level"], one["nodes"]) for one in levels]
    assert [[0.0, 0.0], [0.25, 0.5], [1.0, 1.0]] == [one["errors"] for one in levels]
    tiles = [tile for tile in read_header(data).all_tiles if tile.level == 1]
    assert sum(layer.size for tile in tiles for layer in tile.layers.values()) == levels[1]["size_bytes"]


@pytest.mark.slow
def test_a_number_of_splats_selects_a_version(data, path, tmp_path):
    streamed = tmp_path / "streamed" / "lod-meta.json"
    convert_file(str(path), str(streamed))
    with csplat.open(data) as file:
        counts = {most: len(file.read(tiles=file.cut(max_splats=most))) for most in (80, 240, 5000)}
    coarser = counts_by_level(data, range(3))
    assert len({*counts.values()}) == 3
    for most, wanted in counts.items():
        with csplat.open(path, max_splats=most) as scene, csplat.open(streamed, max_splats=most) as level:
            assert (wanted, wanted) == (scene.count, sum(map(len, scene.blocks())))
            assert max(one for one in coarser if one <= most) == level.count
    csplat.write(tmp_path / "a.ply", csplat.decode(data))
    coarsest = rf"the coarsest version has {coarser[2]} splats, expected at most 9$"
    for scene, words, message in (
        (path, {}, coarsest), (streamed, {}, coarsest), (path, {"level": 1}, "level and max_splats exclude each other"),
        (tmp_path / "a.ply", {}, "the scene, which has no other version, has 400 splats, expected at most 9"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            load_scene(scene, max_splats=9, **words)


@pytest.mark.slow
def test_render_and_compare_draw_a_level(data, path, tmp_path):
    plain, cameras = tmp_path / "coarse.ply", ("--cameras", tmp_path / "cameras.json")
    with csplat.open(data) as file:
        tiles = file.cut(level=1)
        coarse = file.read(tiles=tiles)
        size = sum(layer.size for index in tiles for layer in file.header.all_tiles[index].layers.values())
    save_cameras(cameras[1], orbit_cameras(coarse, 2, 48, 36))
    csplat.write(plain, coarse)

    def images(name, scene, *words):
        call("render", scene, tmp_path / name, *cameras, *words)
        return [image.read_bytes() for image in sorted((tmp_path / name).iterdir())]

    assert images("a", path, "--level", 1) == images("b", plain) != images("c", path)
    words = ("compare", plain, path, *cameras, "--json")
    level, scene = (json.loads(call(*words, *more).stdout) for more in (("--level", 1), ()))
    assert 99 == level["psnr"] > scene["psnr"]
    assert (len(coarse), size) == (level["b"]["splats"], level["b"]["size_bytes"])


@pytest.mark.slow
@pytest.mark.parametrize("framed_splats", [100, 10**6])
def test_an_orbit_is_the_same_for_all_levels(path, tmp_path, monkeypatch, framed_splats):
    seen = []
    monkeypatch.setattr("csplat_tools.scene_files.FRAMED_SPLATS", framed_splats)
    monkeypatch.setattr("csplat_tools.cli.render.render_folder", lambda _, shots, *__, **___: seen.append(shots))
    for level in ("0", "1", "256"):
        invoke("render", path, tmp_path / level, "--orbit", 2, "--level", level)
    first, *others = ([camera.as_json() for camera in shots] for shots in seen)
    assert [first, first] == others


def test_values_of_the_option_level():
    wanted = {None: (0, None), "2": (2, None), "255": (255, None), "256": (0, 256), "3k": (0, 3000)}
    assert wanted | {"1.5M": (0, 1_500_000)} == {text: parse_level(text) for text in (*wanted, "1.5M")}
    for text in ("-1", "1.5", "k", "all", "5 k", ""):
        with pytest.raises(typer.BadParameter, match="expected a level, as in 1, or a number of splats, as in 500k"):
            parse_level(text)


@pytest.mark.slow
def test_encode_writes_levels(tmp_path, model):
    source, out = tmp_path / "scene.ply", tmp_path / "levels.csplat"
    csplat.write_ply(source, model)
    recorded = json.loads(call("encode", source, out, "--levels", 2, "--json").stdout)["options"]["levels"]
    assert_valid(out.read_bytes())
    assert {0, 1, 2} == {tile.level for tile in read_header(out.read_bytes()).all_tiles}
    assert {"count": 2, "leaf_splats": 1 << 14, "splats": "fitted"} == recorded
    for word in ("17", "all", "0", "-1"):
        refused = call("encode", source, out, "--force", f"--levels={word}", status=2)
        assert "expected auto, merged, 1 to 16 or none" in " ".join(refused.output.split())


@pytest.mark.slow
def test_a_part_has_whole_leaves_and_the_nodes_above_them_and_merged_files_are_a_forest(data, model):
    def made(function, *given):
        stream = io.BytesIO()
        return function(*given, stream), stream.getvalue()

    with csplat.open(data) as file:
        nodes, step = file.nodes, file.header.attributes[3].step
    middle = np.mean(nodes[0].tiles[0].corners(step), axis=0)
    part, cut = made(csplat.extract, data, (*middle, *middle))
    assert_valid(cut)
    assert same(decode(data, tiles=part.tiles), decode(cut, tiles=range(len(part.tiles))))
    kept = [node for node in csplat.open(cut).nodes if node.level == 0]
    assert sum(node.splat_count for node in kept) == part.splat_count == len(decode(cut))
    assert 1 <= len(kept) < 4
    whole, copy = made(csplat.extract, data, (*[-1e6] * 3, *[1e6] * 3))
    assert [node.error for node in nodes] == [node.error for node in csplat.open(copy).nodes]
    assert {0, 2} == {len(node.children) for data in (cut, copy) for node in csplat.open(data).nodes}
    assert len(whole.tiles) == len(read_header(data).all_tiles)
    merged, twice = made(csplat.merge, [data, data])
    assert "" == merged.why
    assert_valid(twice)
    levels = [node.level for node in csplat.open(twice).nodes]
    assert sorted(levels) == levels
    assert 2 == sum(node.parent is None for node in csplat.open(twice).nodes)
    one, both = (decode(file, tiles=csplat.open(file).cut(level=1)).means for file in (data, twice))
    assert np.array_equal(np.concatenate([one, one]), both)
    merged, other = made(csplat.merge, [data, csplat.encode(model.select(slice(0, 100)))])
    assert re.fullmatch("file 2 .* different steps of .*; levels of detail are left out", merged.why), merged.why
    assert () == read_header(other).coarse_tiles


def test_groups_hold_each_point_once_and_are_of_equal_size():
    for count, parts in ((1, 1), (2, 2), (7, 3), (40, 1), (40, 13), (40, 32), (40, 40)):
        groups = kd_groups(np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32), parts)
        sizes = [len(rows) for rows in groups]
        assert parts == len(groups)
        assert max(sizes) - min(sizes) <= 1
        assert list(range(count)) == sorted(np.concatenate(groups).tolist())


@pytest.mark.slow
def test_each_level_below_the_root_has_a_quarter_of_the_splats_of_the_finer_one_at_any_number_of_threads(model):
    builder, contexts = FittedLevelBuilder(leaf_splats=100, root_splats=30), (Context(threads=n) for n in (1, 2))
    nodes, others = (builder.build(model, context) for context in contexts)
    counts = [0] * (nodes[-1].level + 1)
    for node, other in zip(nodes, others, strict=True):
        counts[node.level] += len(node.rows) if node.level == 0 else len(node.splats)
        assert (node.level, node.parent) == (other.level, other.parent)
        assert node.splats is None or same(node.splats, other.splats)
    for finer, coarser in pairwise(counts[:-1]):
        assert finer / 4 <= coarser <= finer / 4 + 4
    assert 1 == sum(node.parent is None for node in nodes)
    assert SPLATS == counts[0]
    assert min(30, counts[-2] // 2) == counts[-1]


@pytest.mark.slow
def test_the_number_of_levels_is_the_one_asked_for_and_very_large_parts_are_merged_alone(model):
    nodes = FittedLevelBuilder(1, leaf_splats=70).build(model)
    assert {0, 1} == {node.level for node in nodes}
    assert 2 == sum(node.parent is None for node in nodes)  # four leaves have one parent, and two have the other
    assert 3 == FittedLevelBuilder(3, leaf_splats=SPLATS).build(model)[-1].level
    header = read_header(csplat.encode(model.select(slice(0, 0)), levels=FittedLevelBuilder()))
    assert (0, ()) == (header.splat_count, header.all_tiles)
    builder = FittedLevelBuilder(1, leaf_splats=SPLATS, whole_splats=SPLATS, fitted_splats=5000)
    parts = [builder.of_scene(model, count).build_part(model, Context(threads=1)) for count in (5000, 5001)]
    fitted, merged = (nodes[1].splats for nodes in parts)
    assert (True, False) == tuple(same(quarter(model, 4), splats) for splats in (merged, fitted))
    assert builder.seconds(5001, 1) < builder.seconds(5000, 1)


@pytest.mark.slow
def test_merged_levels_are_merged_alone_in_scenes_of_any_size(model):
    fitted, merged = (FittedLevelBuilder(2, SPLATS, bucket_splats=300, fits=fits) for fits in (True, False))
    assert ("fitted", "merged") == tuple(builder.settings(SPLATS)["splats"] for builder in (fitted, merged))
    assert merged.seconds(SPLATS, 2) < fitted.seconds(SPLATS, 2)
    level = quarter(model, 4)
    for parts in (merged.build(model), merged.of_scene(model, SPLATS).build_part(model, Context(threads=1))):
        assert same(level, parts[1].splats)
    (top,) = merged.build_top([level], Context(threads=1))[1]
    assert same(quarter(level, 4), top.splats)


def test_the_suite_of_encoders_reports_how_levels_look(model, data):
    case = next(one for one in all_inputs() if one.renders)
    scene, pairs = decode_scene(data), SplatPairs(np.arange(len(model)), 0, 0, 0)
    verdict = check_renders(case, Source.of(model), scene, pairs, data, lambda _, shown: float(len(shown)), 100.0)
    assert dict(zip("12", map(float, counts_by_level(data, (1, 2))), strict=True)) == verdict.details["levels"]
    assert "; level 1 " in verdict.message


@pytest.mark.slow
def test_scenes_have_levels_on_request_only(tmp_path, model, monkeypatch):
    out = tmp_path / "plain.csplat"
    for levels in ({}, {"levels": "auto"}):  # one node of 4,096 splats has no coarser one
        encode_file(load_scene(model), str(out), EncodeOptions(), **levels)
        assert csplat.encode(model.with_metadata(viewing_metadata(model))) == out.read_bytes()
    wanted = {
        (10**9, None): None,
        (4096, "auto"): None,
        (4097, "auto"): FittedLevelBuilder(),
        (9, 2): FittedLevelBuilder(2),
        (2_000_001, "auto"): FittedLevelBuilder(leaf_splats=1 << 15),
        (40_000_001, "auto"): FittedLevelBuilder(),
        (4096, "merged"): None,
        (4097, "merged"): FittedLevelBuilder(fits=False),
    }
    assert wanted == {(count, levels): choose_levels(count, EncodeOptions(), levels) for count, levels in wanted}
    for levels in (0, 17):
        with pytest.raises(InputError, match=f"levels is {levels}, expected 1 to 16, auto or merged"):
            choose_levels(9, EncodeOptions(), levels)
    hide_renderer(monkeypatch)
    assert choose_levels(10**6, EncodeOptions(), None) is None
    with pytest.raises(InputError, match="no compiled renderer"):
        choose_levels(10**6, EncodeOptions(), "auto")


@pytest.mark.slow
@pytest.mark.parametrize("fitted_splats", [400, 399])
def test_buckets_on_disk_give_the_bytes_of_memory_and_of_two_processes(model, tmp_path, fitted_splats):
    options = EncodeOptions(bucket_splats=300)
    builder = FittedLevelBuilder(2, leaf_splats=300, whole_splats=300, fitted_splats=fitted_splats, bucket_splats=300)
    assert ("fitted" if fitted_splats == 400 else "merged") == builder.settings(len(model))["splats"]
    data = csplat.encode(model, options, levels=builder, context=Context(threads=1))
    with csplat.open(data) as file:
        assert [0, 0, 1, 1, 2] == [node.level for node in file.nodes]
        errors = [node.error for node in file.nodes]
        assert 0.0 == min(errors) < errors[2] <= errors[4]
    assert_valid(data)
    # Other processes would fit with all steps.
    context = Context(1, 1, 2_000_000_000) if fitted_splats == 400 else Context(2, 2)
    csplat.encode(model, options, out=tmp_path / "out.csplat", levels=builder, context=context)
    assert bool(data == (tmp_path / "out.csplat").read_bytes())


@pytest.mark.long
def test_a_size_counts_all_levels_and_other_targets_have_them(sample_path, tmp_path):
    model, out = csplat.read(sample_path).select(slice(0, 1200)), tmp_path / "out.csplat"
    target = csplat.Target(size=18_000, prune=False, effort=1)
    result = csplat.encode_with_report(model, levels=FittedLevelBuilder(1), target=target)
    assert 17_460 < len(result.data) == result.report.search.size_bytes <= 18_000
    assert_valid(result.data)
    assert [1200, 300] == counts_by_level(result.data, (0, 1))
    alone = csplat.encode(model, target=replace(target, size=int(0.72 * 18_000)))
    scorer = Scorer.of_source(model, virtual_cameras(model, 3, 96, 72))
    assert scorer.psnr(decode(result.data)) > scorer.psnr(decode(alone)) - 0.3  # as a search for the rest of the size
    np.save(tmp_path / "weights.npy", np.linspace(0.1, 1.0, 1200, dtype=np.float32))
    kept, weights = {"target": csplat.Target(keep=0.5, effort=1)}, {"importance": str(tmp_path / "weights.npy")}
    for what, count in ((kept, 600), (weights, 1200)):
        encoded = encode_file(load_scene(model), str(out), EncodeOptions(), levels=1, **what)
        assert_valid(out.read_bytes())
        assert [count, count // 4] == counts_by_level(out, (0, 1))
        assert encoded.result.report.options["levels"]["count"] == 1
    sharp = csplat.encode_with_report(model, levels=FittedLevelBuilder(1), target=csplat.Target(psnr=28.0, effort=1))
    found = find_view_set(model).validation_scorer(model).psnr(decode(sharp.data))
    assert 28.0 <= found == pytest.approx(sharp.report.search.validation_psnr, abs=1e-4)  # although tiles differ
    assert sharp.report.search.splats < 1200
    target = csplat.Target(max_error={"means": 0.01})
    bounded = csplat.encode_with_report(model, levels=FittedLevelBuilder(1), target=target)
    assert bounded.report.search.size_bytes == len(bounded.data)
    assert 0.005 < bounded.report.errors["means"][0] <= 0.01
    assert_valid(bounded.data)
