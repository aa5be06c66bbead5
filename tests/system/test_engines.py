# SPDX-License-Identifier: Apache-2.0
"""The loaders for three.js, Spark, PlayCanvas and Babylon.js in Chromium, with the versions that the examples pin."""

import shutil
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import absent

from csplat import EncodeOptions, decode, encode
from csplat.editing.transform import convert_axes
from csplat.encoder import EncodePlan, LevelNode, encode_levels
from csplat.formats import write, write_levels
from csplat.ply import read_ply
from csplat.scene import Scene
from csplat_bench.browser import serve
from csplat_bench.engine_stage import ENGINES, pinhole, served
from csplat_bench.subjects.engine_images import settled_image, up_in_world
from csplat_bench.subjects.engine_loaders import Trial
from csplat_render.camera_paths import orbit_cameras
from csplat_render.metrics import psnr

pytestmark = [pytest.mark.slow, pytest.mark.engines]
# Loads files by three.js's own loader of SPZ and by ours: what a program can see of the geometries.
GEOMETRIES = """async ([spz, csplat]) => {
  const { SPZLoader } = await import('three/addons/loaders/SPZLoader.js');
  const { CSPLATLoader } = await import('csplat-decoder/three');
  const seen = [];
  for (const [loader, url] of [[new SPZLoader(), spz], [new CSPLATLoader(), csplat]]) {
    const geometry = await loader.loadAsync(url);
    const attributes = Object.entries(geometry.attributes);
    const { min, max } = geometry.boundingBox;
    seen.push({
      type: geometry.constructor.name,
      keys: Object.keys(geometry).filter((key) => key !== '_listeners'), // ours listens for its disposal
      kinds: attributes.map(([name, { constructor, array, itemSize, normalized, count, usage, gpuType }]) =>
        [name, constructor.name, array.constructor.name, itemSize, normalized, count, usage, gpuType]),
      bounds: [min, max, geometry.boundingSphere.center].map((place) => place.toArray()),
      values: attributes.map(([, { array, itemSize }]) =>
        Array.from(array instanceof Uint32Array ? new Uint8Array(array.buffer) : array)),
    });
  }
  return seen;
}"""
EXAMPLES = Path(__file__).resolve().parents[2] / "tools" / "examples"
FAST = EncodeOptions(preset="fast")

#: The PLY as read by the engine's own loader: Spark's cuts SH that exceeds a power of two.
LIKE_THE_PLY = {"three": 60.0, "playcanvas": 45.0, "babylon": 60.0, "spark": 38.0}


@pytest.fixture(scope="module")
def packages():
    npm = shutil.which("npm") or absent("the engines come from npm, which is not installed")
    lock, installed = EXAMPLES / "package-lock.json", EXAMPLES / "node_modules" / ".package-lock.json"
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        words = [npm, "ci", "--silent", "--ignore-scripts", "--no-audit", "--no-fund"]
        subprocess.run(words, cwd=EXAMPLES, check=True, capture_output=True)
    return EXAMPLES / "node_modules"


@pytest.fixture(scope="module")
def files(packages, sample_path):
    """A served folder with a scene in all tested states, the scene, and a camera."""
    source = read_ply(sample_path).select(slice(0, 4001))  # no multiple of anything
    data = encode(source, replace(FAST, tile_splats=3000))
    model = decode(data)
    camera = orbit_cameras(model, 8, 120, 90)[1]
    with served(packages) as (folder, address):
        for name, content in {
            "scene": data,
            "flipped": data[:-9] + bytes([data[-9] ^ 4]) + data[-8:],
            "cut": data[: len(data) // 2],
            "text": b"no scene",
            "left": encode(convert_axes(Scene.of(model), "LUF").model(), FAST),
        }.items():
            (folder / f"{name}.csplat").write_bytes(content)
        write(folder / "scene.ply", model, "ply")
        yield folder, address, model, camera


@contextmanager
def started(browser, files, engine):
    _, address, model, camera = files
    page = browser.new_page(device_scale_factor=1)
    page.set_default_timeout(60_000)
    yield Trial(page, address, engine, pinhole(camera, model)).start()
    page.close()


@pytest.fixture(scope="module", params=ENGINES)
def trial(request, browser, files):
    with started(browser, files, request.param) as one:
        yield one


@pytest.fixture(scope="module")
def picture(trial):
    """The engine's picture of the scene and its messages."""
    return shown(trial, "scene.csplat")


def shown(trial, name, **options):
    """Show a file and remove it again; return the picture and the engine's messages."""
    said = trial.show(name, **options)
    assert "failed" not in said, said
    image = settled_image(trial.page, 0.2)  # it redraws continuously, which takes most of these tests' time
    trial.remove()
    return image, said


def test_a_scene_is_upright_and_equals_ours(trial, picture, files):
    image, said = picture
    _, _, model, camera = files
    assert said["count"] - len(model) in range(16)  # Babylon.js fills up
    assert "upright" == up_in_world(model, said["world"])
    ours = ENGINES[trial.engine].render(model, camera, 3)
    assert psnr(image, ours) > max(30.0, psnr(image, ours[:, ::-1]) + 3.0)


def test_a_left_handed_scene_in_two_steps_ends_in_the_same_picture(trial, picture):
    again, _ = shown(trial, "left.csplat", moved=False, progressive=True)  # seen from where the last one was
    assert psnr(picture[0], again) > 35.0


def test_band_4_is_drawn_or_reported_once(trial, files):
    folder, _, model, camera = files
    band = np.random.default_rng(4).normal(0.0, 0.2, (len(model), 9, 3)).astype(np.float32)
    model = replace(model, shN=np.concatenate([model.shN, band], axis=1))
    (folder / "degree_4.csplat").write_bytes(encode(model, replace(FAST, sh_coding="scalar")))
    told = []
    trial.page.on("console", lambda message: told.append(message.text))
    for options in ({}, {"progressive": True}):
        image, _ = shown(trial, "degree_4.csplat", **options)
        to_3, to_4 = (psnr(image, ENGINES[trial.engine].render(model, camera, degree)) for degree in (3, 4))
        assert (to_4 > to_3 + 2.0) == (trial.engine == "babylon"), (to_3, to_4)
        assert abs(to_4 - to_3) > 2.0
    warnings = [text for text in told if "the engine ends at degree 3" in text]
    assert len(warnings) == (trial.engine != "babylon")


def test_the_picture_equals_the_picture_of_the_ply(trial, picture):
    assert psnr(picture[0], shown(trial, "scene.ply")[0]) > LIKE_THE_PLY[trial.engine]


def test_a_splat_far_away_does_not_spoil_the_order_in_three_js(trial, picture, files):
    if trial.engine != "three":
        pytest.skip("the order of the other engines does not depend on the loader")
    folder, _, model, _ = files
    far = model.select(np.arange(len(model) + 1) % len(model))
    far.means[-1] = [0.0, 0.0, 3e3]
    (folder / "far.csplat").write_bytes(encode(far, replace(FAST, tile_splats=256)))
    assert psnr(picture[0], shown(trial, "far.csplat")[0]) > 42.0


def test_a_part_far_from_most_splats_is_drawn_and_sorted(trial, files):
    folder, _, model, _ = files
    copies = model.select(np.arange(4 * len(model)) % len(model))
    copies.means[len(model) :] += 500.0 * np.repeat(np.eye(3, dtype=np.float32), len(model), axis=0)
    (folder / "parts.csplat").write_bytes(encode(copies, replace(FAST, tile_splats=1000)))
    least = {"three": 38.0, "playcanvas": 25.0, "babylon": 30.0, "spark": 25.0}[trial.engine]
    alone, _ = shown(trial, "scene.csplat")  # seen from where this one is
    assert psnr(alone, shown(trial, "parts.csplat", moved=False)[0]) > least


@pytest.mark.parametrize(
    ("file", "code"), [("flipped", "E_CRC"), ("cut", "E_TRUNCATED"), ("text", "E_MAGIC"), ("none", "E_INPUT")]
)
def test_errors_of_a_file_are_reported(trial, file, code):
    failed = trial.show(f"{file}.csplat")["failed"]
    assert code == failed["code"]
    assert len(failed["message"]) > 20


def test_loading_can_be_stopped(trial):
    assert "AbortError" == trial.show("scene.csplat", abortAt=1)["failed"]["name"]


def test_disposal_leaves_nothing_on_the_gpu(trial):
    if trial.engine == "three":
        pytest.skip("GaussianSplat of three 0.187 keeps its textures until the renderer is disposed of, of a PLY, too")
    trial.repeat("scene.csplat", 1)
    before = trial.memory()[1]
    trial.repeat("scene.csplat", 2)
    assert trial.memory()[1] <= before + 100_000


@pytest.fixture(scope="module")
def coarser(files):
    """A third of the scene: the coarser level of `levels.csplat`."""
    folder, _, model, _ = files
    third = replace(model.select(slice(0, None, 3)), extra={})
    groups = np.array_split(np.argsort(model.means[:, 0]), 2)
    for name, axes in (("levels", None), ("left_levels", "LUF")):
        whole, part = (convert_axes(Scene.of(one), axes).model() if axes else one for one in (model, third))
        nodes = [LevelNode(0, 2, rows=rows) for rows in groups] + [LevelNode(1, None, splats=part, error=1.0)]
        (folder / f"{name}.csplat").write_bytes(encode_levels(EncodePlan.of(whole, FAST), nodes).write().data)
    return third


def test_a_budget_selects_the_version_of_a_file_with_levels(trial, files, coarser):
    _, _, model, camera = files
    for options, wanted, other in (({"maxSplats": 2000}, coarser, model), ({}, model, coarser)):
        for more in ({}, {"progressive": True}):
            image, said = shown(trial, "levels.csplat", **options, **more)
            assert said["count"] - len(wanted) in range(16), said
            ours, others = (ENGINES[trial.engine].render(one, camera, 3) for one in (wanted, other))
            assert psnr(image, ours) > max(30.0, psnr(image, others) + 3.0)


def test_levels_follow_the_camera(trial, files, coarser):
    _, _, model, camera = files
    failed = []
    trial.page.on("console", lambda message: failed.append(message.text) if message.type == "error" else None)
    for error, wanted, other in ((1e-3, model, coarser), (1e6, coarser, model)):
        image, _ = shown(trial, "levels.csplat", levels=True, pixelError=error)
        ours, others = (ENGINES[trial.engine].render(one, camera, 3) for one in (wanted, other))
        assert psnr(image, ours) > max(30.0, psnr(image, others) + 3.0)
        again, _ = shown(trial, "left_levels.csplat", moved=False, levels=True, pixelError=error)
        assert psnr(again, image) > 35.0
    before = trial.memory()[1]
    trial.show("levels.csplat", levels=True)
    near = pinhole(camera, model)
    for away, count in ((1e4, len(coarser)), (0.0, len(model)), (1e4, len(coarser))):
        view = [*near["view"][:14], near["view"][14] + away, 1.0]
        trial.look({**near, "view": view, "far": near["far"] + away})
        end = time.monotonic() + 60.0
        while trial.levels() != {"splatCount": count, "isComplete": True}:
            assert time.monotonic() < end, trial.levels()
            time.sleep(0.1)
    trial.remove()
    assert [] == failed
    if trial.engine != "three":  # it keeps its textures, of a PLY, too
        assert trial.memory()[1] <= before + 100_000


def test_three_js_gets_the_geometry_that_its_own_loader_makes_of_spz(browser, files):
    folder, address, model, _ = files
    write(folder / "scene.spz", model)
    with started(browser, files, "three") as stage:
        own, ours = stage.page.evaluate(GEOMETRIES, [f"{address}scene.spz", f"{address}scene.csplat"])
        left = stage.page.evaluate(GEOMETRIES, [f"{address}scene.spz", f"{address}left.csplat"])[1]
    for key in ("type", "keys", "kinds"):
        assert own[key] == ours[key] == left[key]
    np.testing.assert_allclose(own["bounds"], ours["bounds"], atol=2**-12)
    np.testing.assert_allclose(left["bounds"], ours["bounds"], atol=1e-3)
    # SPZ rounds positions to 1/4096, logarithms of scales to 1/16, rotations to 10 bits, and SH to 5 and 4 bits.
    names = [kind[0] for kind in ours["kinds"]]
    pairs = {name: (np.array(a), np.array(b)) for name, a, b in zip(names, own["values"], ours["values"], strict=True)}
    np.testing.assert_allclose(*pairs.pop("position"), atol=2**-12)
    a, b = (values.reshape(-1, 6) for values in pairs.pop("covariance"))
    assert (np.abs(a - b) <= 0.1 * b[:, [0, 3, 5]].sum(axis=1, keepdims=True) + 1e-9).all()
    assert np.abs(np.subtract(*pairs.pop("color"))).max() <= 2
    assert ["sphericalHarmonics1", "sphericalHarmonics2", "sphericalHarmonics3"] == list(pairs)
    for a, b in pairs.values():
        assert np.abs(a - b).max() <= 9
        assert np.corrcoef(a, b)[0, 1] > 0.8


@pytest.mark.parametrize("engine", ["playcanvas", "babylon"])
def test_engines_draw_streamed_sog_of_csplat(browser, files, engine):
    folder, _, model, camera = files
    coarser = model.select(slice(0, None, 4))
    write_levels(folder / engine / "lod-meta.json", [Scene.of(one) for one in (model, coarser)])
    with started(browser, files, engine) as streamed:
        image, _ = shown(streamed, f"{engine}/lod-meta.json")
    ours, quarter = (ENGINES[engine].render(one, camera, 3) for one in (model, coarser))
    assert psnr(image, ours) > max(30.0, psnr(quarter, ours) + 6.0)


@pytest.mark.usefixtures("packages")
def test_the_examples_show_the_sample(browser, sample_path):
    (EXAMPLES / "public").mkdir(exist_ok=True)
    data = encode(read_ply(sample_path), FAST)
    (EXAMPLES / "public" / "scene.csplat").write_bytes(data)
    (EXAMPLES / "public" / "cut.csplat").write_bytes(data[:5000])
    subprocess.run([shutil.which("npm"), "run", "build"], cwd=EXAMPLES, check=True, capture_output=True)
    page = browser.new_page(viewport={"width": 320, "height": 240})
    with serve(EXAMPLES / "dist") as address:
        for name in ENGINES:
            page.goto(f"{address}{name}.html")
            shown = settled_image(page)
            assert "" == page.inner_text("#words"), name
            assert 0.1 < (shown.max(axis=2) > 0.15).mean() < 0.9, name
            page.goto(f"{address}{name}.html?scene=cut.csplat")
            page.wait_for_function("document.querySelector('#words').textContent.length > 20")
            assert "E_" in page.inner_text("#words"), name
    page.close()
