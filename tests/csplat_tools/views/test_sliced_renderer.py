# SPDX-License-Identifier: Apache-2.0
"""Scenes decoded tile by tile, and drawn and compared without being in memory: results equal those in memory.

Also: csplat_tools.views.splat_spool.
"""

import io
import json
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import call
from models import with_facts

import csplat
import csplat_tools
from csplat import Context, EncodeOptions, InputError, disk_files, encode_with_report, file_source, write_ply
from csplat.decoder import Limits, decode, decode_api, iter_tiles, read_header
from csplat.ply import read_ply
from csplat.scene import Scene
from csplat.splat_file import SplatFile
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import renderer
from csplat_tools.scene_files import open_scenes, sample_scene, scene_sizes
from csplat_tools.views import comparison_cameras
from csplat_tools.views.sliced_renderer import SlicedScene, slice_limits


@pytest.fixture
def many_tiles(make_model, tmp_path):
    """Return the path of a file of ten tiles."""
    data = csplat.encode(make_model(600, 2), EncodeOptions(preset="fast", tile_splats=60))
    (tmp_path / "scene.csplat").write_bytes(data)
    assert len(read_header(data).tiles) == 10
    return tmp_path / "scene.csplat"


@pytest.mark.slow
def test_tiles_before_a_damaged_one_are_decoded_but_none_goes_to_standard_output(many_tiles):
    data, whole = bytearray(many_tiles.read_bytes()), io.BytesIO()
    tiles = read_header(data).tiles
    write_ply(whole, decode(bytes(data)))
    assert whole.getvalue() == call("decode", many_tiles, "-", "--quiet").stdout_bytes
    for place in (4, 6):
        layer = tiles[place].layers[0]
        data[layer.offset + layer.size - 1] ^= 1
    for threads in (1, 3):
        decoded = iter_tiles(bytes(data), context=Context(threads=threads))
        assert [tile.splat_count for tile in tiles[:4]] == [len(next(decoded).means) for _ in range(4)]
        with pytest.raises(csplat.CsplatError, match=f"E_CRC at byte {tiles[4].layers[0].offset} "):
            next(decoded)
    many_tiles.write_bytes(data)
    assert b"" == call("decode", many_tiles, "-", "--quiet", status=1).stdout_bytes


@pytest.mark.slow
def test_threads_and_released_pages_do_not_change_the_result_and_limits_are_per_file_or_tile(many_tiles, monkeypatch):
    monkeypatch.setattr(decode_api, "PageReleaser", partial(file_source.PageReleaser, step_bytes=1))
    expected = decode(many_tiles)
    opened = SplatFile.open(many_tiles.read_bytes())
    tiles = [list(iter_tiles(many_tiles, context=Context(threads=threads))) for threads in (1, 3)]
    for models in (*tiles, list(opened.models()), list(opened.models())):
        assert [tile.splat_count for tile in opened.header.tiles] == [len(model.means) for model in models]
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            together = np.concatenate([getattr(model, name) for model in models])
            assert getattr(expected, name).tobytes() == together.tobytes()
    limits = Limits(bytes=max(map(len, opened.models())) * 4 * (11 + 27))
    assert 600 == sum(map(len, SplatFile.open(many_tiles.read_bytes(), limits=limits).models()))
    with pytest.raises(csplat.LimitError, match="bytes"):
        decode(many_tiles, limits=limits)
    with pytest.raises(csplat.LimitError, match="splats"):
        next(SplatFile.open(many_tiles.read_bytes(), limits=Limits(splats=599)).models())


BEHIND = (0.3, 0.6, 0.1)
LITTLE = 1  # byte of memory


@pytest.fixture
def model(make_model):
    cloud = make_model(1500, 1)
    return replace(cloud, scales=cloud.scales * np.float32(0.3) - np.float32(1.5))


@pytest.fixture
def view():
    return look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), intrinsics(70, 53, 60.0), 70, 53)


@pytest.fixture
def files_of_both(model, tmp_path):
    """Return the paths of a PLY, its encoded file and the source index."""
    result = encode_with_report(model, EncodeOptions(preset="fast"))
    source, encoded, index = (str(tmp_path / name) for name in ("scene.ply", "scene.csplat", "index.npy"))
    write_ply(source, model)
    Path(encoded).write_bytes(result.data)
    np.save(index, result.source_index)
    return source, encoded, index


def by_disk(model, every=1):
    """Return a scene in blocks of 300 splats that is drawn in slices of about 100."""
    scene = Scene.like(
        model, len(model), lambda: (model.select(slice(at, at + 300)) for at in range(0, len(model), 300))
    )
    return SlicedScene(scene, model.select(slice(None, None, every)), every, LITTLE, slice_bytes=60_000)


@pytest.fixture
def counts(monkeypatch):
    """Record the number of splats in each slice that is drawn."""
    found, forward = [], Rasteriser.forward

    def noted(rasteriser, splats, *words, state=None, **named):
        if state is not None:
            found.append(len(splats.means))
        return forward(rasteriser, splats, *words, state=state, **named)

    monkeypatch.setattr(Rasteriser, "forward", noted)
    return found


def assert_same_render(model, view, every=1, mode="standard"):
    wanted, found = (renderer(scene, BEHIND, mode=mode)(view) for scene in (model, by_disk(model, every)))
    for name in ("rgb", "alpha", "depth", "ignored"):
        np.testing.assert_array_equal(getattr(wanted, name), getattr(found, name))


def test_sliced_renders_equal_those_in_memory(model, view, counts):
    crowd, flat, far = model.means.copy(), model.means.copy(), model.means + np.float32([0, 0, -90])
    crowd[:900, 2] = flat[:, 2] = 0.25
    for scene, options in (
        (model, {"mode": "fast"}),
        (with_facts(model, antialiased=True), {}),
        (model, {"every": 700}),  # the sample decides the slices
        (replace(model, means=crowd), {}),  # splats of one depth are drawn in their order
        (replace(model, means=flat), {}),
        (replace(model, means=far), {}),  # out of view
        (model.select(slice(0, 0)), {}),
    ):
        assert_same_render(scene, view, **options)
    assert len(counts) > 5
    assert max(counts) < 300


def test_splats_behind_opaque_pixels_are_not_drawn(model, view, counts):
    model.means[:20], model.scales[:20], model.opacities[:20] = (0.0, 0.0, -2.5), 3.0, 0.99
    assert_same_render(model, view)
    assert sum(counts) < 600


def test_slices_have_equal_costs_and_do_not_split_a_depth():
    near, same = np.array([0, 5, 1, 2, 4, 3], np.float32), np.float32(2.0)
    taken = np.where(near > 0, 10.0, 0.0)
    assert [] == slice_limits(near, taken, 1).tolist() == slice_limits(0 * near, 0 * taken, 9).tolist()
    assert [2.0, 4.0] == slice_limits(near, taken, 3).tolist()
    assert [same, np.nextafter(same, np.float32(3.0))] == slice_limits(np.full(9, same), np.ones(9), 4).tolist()


def test_scenes_that_fit_are_loaded_and_others_opened(files_of_both):
    with open_scenes(files_of_both[:2]) as loaded, open_scenes(files_of_both[:2], Context(memory=LITTLE)) as opened:
        assert all(scene.in_memory is not None for scene in loaded)
        assert [None, None] == [scene.in_memory for scene in opened]
        assert [scene_sizes(scene) for scene in loaded] == [scene_sizes(scene) for scene in opened]
        with open_scenes(opened) as again:
            assert opened == again
        with open_scenes((loaded[0], files_of_both[1]), Context(memory=LITTLE)) as both:
            assert all(scene.in_memory is not None for scene in both)


def test_a_sample_has_every_nth_splat_and_gives_about_the_same_views(files_of_both, model, sample_path):
    reports = []
    with open_scenes(files_of_both[:2], Context(memory=LITTLE)) as (source, _):
        found, every = sample_scene(source, splats_max=220, progress=lambda _, done: reports.append(done))
    assert (7, 0, 1.0) == (every, found.sh_degree, reports[-1])
    np.testing.assert_array_equal(model.means[::7], found.means)
    whole = read_ply(sample_path)
    part = comparison_cameras(whole.select(slice(None, None, 2)), every=2)
    for wanted, seen in zip(comparison_cameras(whole), part, strict=True):
        assert np.linalg.norm(wanted.position) == pytest.approx(np.linalg.norm(seen.position), rel=0.15)


@pytest.mark.slow
def test_an_out_of_core_comparison_equals_one_in_memory(files_of_both, model, view, tmp_path, monkeypatch):
    # Any memory is accepted here, as small scenes fit into all that is accepted otherwise.
    monkeypatch.setattr(SlicedScene, "least_bytes", -(10**12))
    (source, encoded, index), camera_file = files_of_both, str(tmp_path / "cameras.json")
    save_cameras(camera_file, [view])
    words = ("compare", source, encoded, "--cameras", camera_file)

    def report(name):
        result = call(*words, "--source-index", index, "--json", "--pictures", tmp_path / name)
        shown = json.loads(result.stdout)
        images = [image.read_bytes() for image in sorted((tmp_path / name).iterdir())]
        by_disk = "rendered from the disk" in result.stderr
        assert by_disk == (not shown.pop("elsewhere"))  # views off the path are not rendered out of core
        return by_disk, shown["attributes"].pop("errors"), (shown | {"seconds": 0}, images)

    by_disk, errors, in_memory = report("memory")
    assert not by_disk
    monkeypatch.setattr("csplat_tools.cli.compare.open_scenes", partial(open_scenes, context=Context(memory=LITTLE)))
    by_disk, others, of_disk = report("disk")
    assert by_disk
    assert bool(in_memory == of_disk)
    assert errors == {name: pytest.approx(error, rel=1e-12) for name, error in others.items()}
    assert "the errors of splats are unknown" in call(*words).stdout  # without an index
    refused = call("compare", source, encoded, "--backend", "exact", status=1)
    assert "error: --backend exact requires both scenes in memory" in refused.stderr
    moved, views = tmp_path / "moved.ply", csplat_tools.find_view_set(model, cameras=camera_file, count=0)
    write_ply(moved, replace(model, means=model.means + np.float32(0.001)))
    wanted, shown = (
        csplat_tools.compare(source, str(moved), views=views, context=Context(memory=most)) for most in (None, LITTLE)
    )
    assert (wanted.quality, "order") == (shown.quality, shown.attributes.pairing)
    others = {name: pytest.approx(error, rel=1e-12) for name, error in shown.attributes.errors.items()}
    assert wanted.attributes.errors == others


def test_what_cannot_be_drawn_is_an_error_before_drawing(model, view, files_of_both, monkeypatch):
    with pytest.raises(InputError, match="exact"):
        renderer(by_disk(model), BEHIND, mode="exact")(view)
    monkeypatch.setattr(SlicedScene, "least_bytes", 450_000_000)
    with pytest.raises(InputError, match=r"^the memory is 0 MB, expected at least 482 MB to draw these scenes$"):
        csplat_tools.compare(*files_of_both[:2], context=Context(memory=LITTLE))
    monkeypatch.setattr(SlicedScene, "least_bytes", -(10**12))
    monkeypatch.setattr(disk_files.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(InputError, match="TMPDIR"):
        csplat_tools.compare(*files_of_both[:2], context=Context(memory=LITTLE))


def test_an_interrupted_render_leaves_no_files(model, view, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def interrupted(_, share):
        if share > 0.61:  # the first slice was read from the disk and drawn
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        renderer(by_disk(model), BEHIND, context=Context(progress=interrupted))(view)
    assert [] == list(tmp_path.iterdir())
