"""The benchmarks of renderer and trainer: that they measure what they say, on little."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")
pytest.importorskip("scipy", reason="training wants the extra [render]")
pytest.importorskip("PIL.Image", reason="pictures want the extra [render]")

from benching import bench
from oracle import cropped, difference

from csplat.ply import read_ply
from csplat_bench.common.making import crowd, split
from csplat_bench.viewer.rules import Engine
from csplat_render import render
from csplat_render.virtual_cameras import virtual_cameras

pytestmark = pytest.mark.area(name="benchmarks")


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path)


def test_a_crowd_has_as_many_splats_in_view_as_it_says(sample):
    cameras = virtual_cameras(sample, 3, 160, 120)
    count = 2 * len(sample)
    found = crowd(sample, cameras, count)
    drawn = np.median([render(found, camera).drawn for camera in cameras])
    assert abs(drawn - count) <= 0.02 * count


def test_split_splats_have_the_spread_of_the_whole(make_model):
    model = make_model(1, 0, scales=np.log(np.array([[0.5, 0.1, 0.02]], np.float32)))
    parts = split(model, 20_000, np.random.default_rng(0))
    assert len(parts) == 20_000
    w, x, y, z = model.quats[0].astype(np.float64)
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = (parts.means - model.means[0]) @ axes
    total = np.sqrt(local.var(axis=0) + np.exp(2.0 * parts.scales[0]))
    np.testing.assert_allclose(total, [0.5, 0.1, 0.02], rtol=0.03)


def test_the_middle_of_a_picture_is_the_same_pixel_for_pixel(sample):
    view = virtual_cameras(sample, 1, 160, 120)[0]
    whole, middle = render(sample, view).rgb, render(sample, cropped(view, 40, 30)).rgb
    off = difference(middle, whole[45:75, 60:100])
    assert off.share <= 0.02  # splats whose centres lie far outside are linearised elsewhere
    assert off.mean <= 1e-3


def test_the_renderer_is_measured(tmp_path):
    bench("rendering", "--scenes", "sample", "--views", 1, "--rounds", 1, "--json", tmp_path / "r.json")
    results = json.loads((tmp_path / "r.json").read_text())["results"]
    assert ["sample standard", "sample fast", "sample antialiased"] == list(results)
    assert all(one["forward"]["wall"] > 0.0 and one["backward"]["wall"] > 0.0 for one in results.values())
    assert results["sample standard"]["psnr"] is None
    assert 30.0 < results["sample fast"]["psnr"] < 60.0


def test_training_is_measured(data_dir, tmp_path):
    folder = data_dir / "images" / "lego200"
    if not folder.is_dir():
        pytest.skip("the Lego pictures are absent")
    bench("training", folder, "--rows", "200:40x40", "--warm", 2, "--steps", 5, "--json", tmp_path / "t.json")
    (result,) = json.loads((tmp_path / "t.json").read_text())["results"]
    assert all(result["seconds"][name] > 0.0 for name in ("step", "forward", "loss", "backward", "Adam"))
    assert result["memory_bytes"] > 0


def test_cameras_are_compared(data_dir, tmp_path):
    if not (data_dir / "psnr_cameras" / "plane3.json").exists():
        pytest.skip("plane3 is absent")
    words = ("--scenes", "plane3", "--presets", "fast", "--seeds", "0", "--no-peers", "--cache", tmp_path)
    bench("codec.quality", *words, "--json", tmp_path / "q.json")
    ((one,),) = json.loads((tmp_path / "q.json").read_text())["scenes"].values()
    assert abs(one["differences"][0]) <= 1.0


def test_rules_of_colours_change_no_picture_whose_colours_stay_in_their_range(sample):
    view = virtual_cameras(sample, 1, 80, 60)[0]
    pale = replace(sample, sh0=0.2 * sample.sh0, shN=0.2 * sample.shN)
    plain, clipped = Engine("plain", ()), Engine("clipped", (), clips=True)
    np.testing.assert_allclose(clipped.drawn(pale, view, 3), plain.drawn(pale, view, 3), atol=1e-4)
    assert np.abs(clipped.drawn(sample, view, 3) - plain.drawn(sample, view, 3)).max() > 0.01
