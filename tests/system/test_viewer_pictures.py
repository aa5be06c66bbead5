# SPDX-License-Identifier: Apache-2.0
"""Pictures of the viewer's engine, in headless Chromium, against the rasteriser's of the decoded model."""

import base64
import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from checked import cloud
from chromium import read_pixels
from models import with_facts

import csplat
from csplat import EncodeOptions, decode, encode
from csplat.decoder import read_header
from csplat.model import normalise_quats
from csplat.ply import read_ply
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.level_builder import FittedLevelBuilder

pytestmark = [pytest.mark.slow, pytest.mark.browser]

#: Well above the required 38 dB: leaving out all SH gives 33, 8-bit rounding alone 59.
GOOD = 50.0
FAST = EncodeOptions(preset="fast")


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path)


@pytest.fixture(scope="module")
def part(sample):
    return sample.select(slice(0, 2000))


@pytest.fixture(scope="module")
def part_file(part):
    return encode(part, FAST)


@pytest.fixture(scope="module")
def levels_file(sample):
    return encode(sample, levels=FittedLevelBuilder(leaf_splats=1200, root_splats=150))


@pytest.fixture
def remade(engine):
    """Return a function that makes the engine with other options, for one test."""

    def start(options):
        engine.start_again(options)
        return engine

    yield start
    engine.page.evaluate("void (errors.length = 0)")
    engine.start_again()


def reference(model, camera, background=(0, 0, 0), **options):
    return np.clip(render(model, camera, background=background, **options).rgb, 0.0, 1.0)


def psnr(a, b):
    return -10.0 * math.log10(max(float(np.mean((a - b) ** 2)), 10**-9.9))


def view(model, size):
    """Return a square camera of the middle of a scene."""
    (camera,) = virtual_cameras(model, 1)
    zoom = size / min(camera.W, camera.H)
    K = np.array([[camera.K[0, 0] * zoom, 0, size / 2], [0, camera.K[1, 1] * zoom, size / 2], [0, 0, 1]])
    return replace(camera, K=K, W=size, H=size)


@pytest.fixture(scope="module")
def camera(part):
    return view(part, 80)


@pytest.fixture(scope="module")
def wide(sample):
    return view(sample, 96)


def in_front(size):
    return look_at((0, 0, -3.0), (0, 0, 0), (0, -1, 0), intrinsics(size, size, 50.0), size, size)


ERRORS = "errors.map(({ code, fatal }) => [code, fatal])"


def near(camera, model, factor):
    """Return a camera at a multiple of the distance from the middle of a scene."""
    pose = camera.viewmat.copy()
    middle = pose[:3, :3] @ model.means.mean(axis=0)
    pose[:3, 3] = (pose[:3, 3] + middle) * factor - middle
    return replace(camera, viewmat=pose)


def make(means, **fields):
    """Return a model of splats with these means; fields that are not given make small grey balls."""
    given = {name: np.asarray(value, np.float32) for name, value in fields.items()}
    if "quats" in given:
        given["quats"] = normalise_quats(given["quats"])
    means = np.reshape(means, (-1, 3))
    return cloud(means, **{"scales": np.full(means.shape, -2.0, np.float32), **given})


def test_the_sample_looks_as_the_rasteriser_draws_it_at_a_fraction_of_its_memory(engine, sample):
    model = opened(engine, sample)
    camera = view(model, 160)
    assert psnr(engine.picture(camera), reference(model, camera)) >= GOOD
    engine.page.evaluate("engine.requestFrame(), engine.settled()")
    stats = engine.stats()
    assert len(model) == stats["splatsResident"]
    assert 236 == stats["expandedBytesPerSplat"]
    assert stats["gpuBytesPerSplat"] < 40  # for few splats; rows of textures are whole


def test_the_antialiased_flag_is_honoured(engine, part, camera):
    pictures = []
    for flag in (False, True):
        model = opened(engine, with_facts(part, antialiased=flag))
        pictures.append(engine.picture(camera))
        assert psnr(pictures[-1], reference(model, camera)) >= GOOD
    assert psnr(*pictures) < 44


def test_the_level_with_no_visible_error_is_drawn(remade, part, camera):
    data = encode(part, levels=FittedLevelBuilder(leaf_splats=700, root_splats=200))
    with csplat.open(data) as file:
        coarsest = file.cut(level=max(node.level for node in file.nodes))
    assert read_header(data).coarse_tiles
    for error, tiles in ((0, None), (1e9, coarsest)):
        engine, model = remade(f"{{ pixelError: {error} }}"), decode(data, tiles=tiles)
        engine.look(camera)
        assert engine.open(data) is None
        assert psnr(engine.picture(camera), reference(model, camera)) >= GOOD
        resident = engine.stats()["splatsResident"]
        total = sum(tile.splat_count for tile in read_header(data).all_tiles)
        assert len(part) < resident <= total if tiles is None else len(model) == resident


@pytest.mark.parametrize("backend", ["webgl2", "webgpu-tiles"])
def test_an_image_has_the_details_that_its_size_requires(remade, wide, sample, levels_file, backend):
    engine = remade(f"{{ backend: '{backend}', pixelError: 3 }}")
    engine.look(view(sample, 12))
    assert engine.open(levels_file) is None
    few = engine.stats()["splatsResident"]
    engine.page.evaluate("engine.toBlob({ width: 96 }).then((blob) => createImageBitmap(blob)).then((made) => {"
        " const context = new OffscreenCanvas(96, 96).getContext('2d'); context.drawImage(made, 0, 0);"
        " window.image = context.getImageData(0, 0, 96, 96).data; })")  # fmt: skip
    image = read_pixels(engine.page, "image", 96, 96)[..., :3] / 255.0
    assert few < engine.stats()["splatsResident"]
    assert [12, 12] == engine.page.evaluate("[engine.canvas.width, engine.view.width]")
    assert psnr(image, engine.picture(wide)) >= GOOD


@pytest.mark.parametrize("backend", ["webgl2", "webgpu-tiles"])
def test_the_whole_scene_is_shown_coarsely_while_a_file_with_levels_arrives(remade, wide, levels_file, backend):
    engine = remade(f"{{ backend: '{backend}', pixelError: 0 }}")
    model = decode(levels_file)
    engine.look(wide)
    engine.site.bytes_left = len(levels_file) // 2
    url = engine.site.add("/scene.csplat", levels_file)
    try:
        engine.page.evaluate("(url) => void (window.opened = engine.open(url))", url)
        engine.page.wait_for_function("engine.stats.firstPictureMs > 0")
        stats = engine.stats()
        early = engine.picture_of_now(wide)
    finally:
        engine.site.bytes_left = math.inf
    assert stats["splatsResident"] < len(model)
    assert 0 < stats["firstPictureBytes"] < len(levels_file) / 2
    engine.page.evaluate("opened")
    whole = engine.picture(wide)
    assert psnr(whole, reference(model, wide)) >= GOOD
    assert psnr(early, whole) > psnr(np.zeros_like(whole), whole) + 6
    assert engine.stats()["splatsDrawn"] <= len(model) <= engine.stats()["splatsResident"]


@pytest.mark.parametrize("backend", ["webgl2", "webgpu-tiles"])
def test_the_memory_is_bounded_wherever_the_camera_goes(remade, backend):
    rng = np.random.default_rng(5)
    places = np.arange(-120.0, 121.0, 10.0)
    means = np.concatenate([rng.normal((x, 0, 0), 1.5, (400, 3)) for x in places])
    row = make(means, sh0=rng.normal(0, 1, means.shape))
    data = encode(row, levels=FittedLevelBuilder(leaf_splats=400, root_splats=150))
    total = sum(tile.splat_count for tile in read_header(data).all_tiles)
    engine = remade(f"{{ backend: '{backend}', maxSplats: 5200, pixelError: 0 }}")
    engine.open(data)
    pictures, here = [], []
    cameras = [look_at((x, 0, -20), (x, 0, 0), (0, -1, 0), intrinsics(64, 64, 30), 64, 64) for x in places[::3]]
    for camera in cameras:
        pictures.append(engine.picture(camera))
        here.append({*engine.page.evaluate("[...engine.opening.resident.keys()]")})
        stats = engine.stats()
        assert stats["splatsResident"] <= 10_400 < total
        assert stats["splatsDrawn"] <= 5200
    assert any(before - after for before, after in itertools.pairwise(here))  # some were evicted
    for camera, picture in zip(cameras, pictures, strict=True):
        assert psnr(picture, reference(decode(data), camera)) >= 30
        assert psnr(engine.picture(camera), picture) >= 30  # what was evicted returns


def test_a_damaged_tile_is_reported_and_drawn_coarsely(remade, wide, levels_file):
    engine = remade("{ pixelError: 0 }")
    layer = read_header(levels_file).tiles[3].layers[0]
    damaged = bytearray(levels_file)
    damaged[layer.offset + layer.size // 2] ^= 4
    engine.look(wide)
    assert engine.open(bytes(damaged)) is None
    picture = engine.picture(wide)
    assert [["E_CRC", False]] == engine.page.evaluate(ERRORS)
    assert 20 < psnr(picture, reference(decode(levels_file), wide)) < GOOD


def test_a_lost_connection_is_reported_once_and_tried_again(remade, sample, wide, levels_file):
    engine = remade("{ pixelError: 1 }")
    engine.look(near(wide, sample, 1000))
    assert engine.open(levels_file) is None
    before = engine.stats()["splatsResident"]
    engine.site.breaks = True
    try:
        engine.look(near(wide, sample, 0.5))
        engine.page.wait_for_function("errors.length > 0")
        assert [["E_INPUT", False]] == engine.page.evaluate(ERRORS)
    finally:
        engine.site.breaks = False
    engine.page.evaluate("engine.settled()")
    assert before < engine.stats()["splatsResident"]
    engine.tab.problems.clear()  # the browser logs requests that failed


def test_background_and_degree_can_be_chosen(engine, part_file, camera):
    engine.open(part_file)
    model, colour = decode(part_file), (0.2, 0.6, 1.0)
    picture = engine.picture(camera, colour)
    assert psnr(picture, reference(model, camera, colour)) >= GOOD
    assert psnr(picture, engine.picture(camera)) < 30
    for degree in (0, 1, 2):
        assert psnr(engine.picture(camera, degree=degree), reference(model, camera, sh_degree=degree)) >= GOOD
    assert "E_INPUT" == engine.page.evaluate(
        "(() => { try { engine.setBackground('transparent'); } catch ({ code }) { return code; } })()"
    )


def test_every_format_of_the_picture_is_good_enough(remade, part_file, camera):
    model = decode(part_file)
    for wanted, least in (("RGBA32F", GOOD), ("RGBA16F", GOOD), ("RGBA8", 38)):
        engine = remade("{}" if wanted == "RGBA32F" else json.dumps({"pictureFormat": wanted}))
        engine.open(part_file)
        assert psnr(engine.picture(camera), reference(model, camera)) >= least
        assert wanted == engine.stats()["pictureFormat"]


def opened(engine, source, options=FAST):
    """Encode and show a scene; return what the file holds."""
    data = encode(source, options)
    assert engine.open(data) is None
    return decode(data)


def unlike(engine, scenes, camera, least):
    """Return names and PSNR of scenes that the engine draws unlike the rasteriser, of pairs of a model and options."""
    found = {}
    for name, scene in scenes.items():
        wanted = reference(opened(engine, *scene), camera)
        found[name] = psnr(engine.picture(camera), wanted)
    return {name: value for name, value in found.items() if value < least}


CODINGS = {
    "scalar": {"sh_coding": "scalar"}, "wide integers": {"sh_coding": "scalar", "sh_step": 1e-6},
    "codebook": {"sh_coding": "codebook", "codebook_size": 300, "escape_fraction": 0.2}, "degree 1": {"sh_degree": 1},
    "degree 0": {"sh_degree": 0}, "tiles": {"tile_splats": 300},
    "records of several texels": {"means_coding": "axis", "position_step": 1e-6, "scale_step": 1e-5, "sh0_step": 1e-6},
    "widest levels": {"opacity_levels": 65535, "quat_levels": 32767},
}  # fmt: skip


def test_every_coding_is_drawn(engine, sample, camera):
    part = sample.select(slice(0, 600))
    scenes = {name: (part, EncodeOptions(preset="fast", **options)) for name, options in CODINGS.items()}
    assert {} == unlike(engine, scenes, camera, GOOD)


def one_coefficient_each():
    """75 splats, each with one SH coefficient of one channel; none hides another along any axis."""
    k = np.arange(75)
    x, y = k % 9, k // 9
    means = np.stack([x, y, (x + 2 * y) % 9], axis=1) - 4.0
    coefficients = np.zeros((75, 25, 3), np.float32)
    coefficients[k, k % 25, k // 25] = np.where(k % 2, 0.5, -0.5)
    return make(means, sh0=coefficients[:, 0], shN=coefficients[:, 1:])


@pytest.mark.parametrize("coding", [{"sh_coding": "scalar"}, {"sh_coding": "codebook", "codebook_size": 60}])
def test_each_coefficient_alone_from_eight_directions(engine, coding):
    options = EncodeOptions(preset="fast", sh_step=0.01, sh0_step=0.01, **coding)
    model = opened(engine, one_coefficient_each(), options)
    assert 75 * 72 > np.count_nonzero(model.shN) >= 72
    K = intrinsics(256, 256, 25.0)
    for axis in np.concatenate([np.eye(3), -np.eye(3), [[0.2, 0.5, 0.84], [-0.8, 0.33, -0.5]]]):
        camera = look_at(26.0 * axis, (0, 0, 0), np.roll(axis, 1), K, 256, 256)
        shown = [engine.picture(camera, degree=degree) for degree in range(5)]
        wanted = [reference(model, camera, sh_degree=degree) for degree in range(5)]
        assert np.abs(np.subtract(shown, wanted)).max() <= 2 / 255
        for band in range(1, 5):  # each shows
            assert np.abs(wanted[band] - wanted[band - 1]).max() > 0.05, (axis, band)


EXTREMES = {
    "none": make(np.zeros((0, 3))),
    "one": make([[0.3, -0.2, 0.0]], sh0=[[1, 0, -1]], scales=[[-1, -2, -3]]),
    "huge": make([[0, 0, 2]] * 2, scales=[[60, 60, 60], [-2, -2, -2]], sh0=[[1, 0, 0], [0, 1, 0]]),
    "vanishing": make([[0, 0, 0], [0.5, 0, 0]], scales=[[-60, -60, -60], [-80, -80, -80]]),
    "needle": make([[0, 0, 0]], scales=[[8, -7, -7]], quats=[[0.9, 0.1, 0.2, 0.3]]),
    "disc": make([[0, 0, 0]], scales=[[1, 1, -30]], quats=[[0.9, 0.3, 0.2, 0.1]]),
    "inside": make([[0, 0, -3.0], [0, 0, -2.7], [0, 0, 5]], scales=[[0, 0, 0], [-1, -1, -1], [1, 1, 1]]),
    "opaque and absent": make([[0, 0, 0], [1, 0, 0], [0, 1, 0]], opacities=[1, 0, 1 / 255]),
    "bright and dark": make([[0, 0, 0], [1, 0, 0]], sh0=[[1e4, 1e6, 0], [-1e6, 3, 0]]),
    "far away": make([[0, 0, 1e6], [1e5, 0, 1e6]], scales=[[9, 9, 9], [12, 8, 8]]),
}


@pytest.mark.parametrize("backend", ["webgl2", "webgpu-tiles", "webgpu-quads"])
def test_extremes_are_drawn_as_the_rasteriser_draws_them(remade, backend):
    engine = remade(f"{{ backend: '{backend}' }}")
    assert {} == unlike(engine, {name: (model,) for name, model in EXTREMES.items()}, in_front(size=200), 45)


def test_far_from_the_origin_the_picture_does_not_change(engine):
    rng = np.random.default_rng(0)
    means, scales = np.round(rng.uniform(-20, 20, (400, 3)) * 64) / 64, rng.uniform(-1, 1, (400, 3))
    near = make(means, scales=scales, quats=rng.standard_normal((400, 4)), sh0=rng.standard_normal((400, 3)))
    offset = np.array([2.0**17, -(2.0**17), 2.0**16])  # binary32 still has 1/64 there
    options = EncodeOptions(preset="fast", position_step=1 / 64)
    pictures = []
    for shift in (np.zeros(3), offset):
        opened(engine, replace(near, means=near.means + shift.astype(np.float32)), options)
        eye, target = shift + np.array([3.0, -5.0, -40.0]), shift + np.array([0.37, 0.2, 0.1])
        pictures.append(engine.picture(look_at(eye, target, (0, -1, 0), intrinsics(128, 128, 60.0), 128, 128)))
    assert np.abs(pictures[0] - pictures[1]).max() <= 2 / 255
    assert psnr(*pictures) >= GOOD


HOLD = """() => {
  const take = engine.worker.onmessage;
  const held = [];
  engine.worker.onmessage = (event) =>
    ['table', 'band', 'done'].includes(event.data.type) ? held.push(event) : take(event);
  window.release = () => ((engine.worker.onmessage = take), held.forEach(take));
}"""


def test_a_scene_appears_from_layer_0_and_sharpens(engine, sample):
    data = encode(sample, EncodeOptions(preset="fast", sh_coding="scalar", sh_step=0.001, tile_splats=1000))
    model = decode(data)
    layer0 = sum(tile.layers[0].size for tile in read_header(data).tiles)
    camera = view(model, 128)
    engine.look(camera)
    engine.page.evaluate(HOLD)
    engine.page.evaluate("(url) => void (window.opened = engine.open(url))", engine.site.add("/scene.csplat", data))
    engine.page.wait_for_function("engine.stats.firstPictureMs > 0")
    stats = engine.stats()
    assert len(model) == stats["splatsResident"]
    assert stats["firstPictureBytes"] < layer0 + 70_000 < stats["fileSize"]
    assert psnr(engine.picture_of_now(camera), reference(model, camera, sh_degree=0)) >= GOOD
    engine.page.evaluate("release(), opened")
    assert psnr(engine.picture(camera), reference(model, camera)) >= GOOD


def test_files_may_be_in_memory(engine, part_file, camera):
    engine.open(part_file)
    wanted = engine.picture(camera)
    for kind in ("bytes.buffer", "new Blob([bytes])", "new File([bytes], 'a.csplat')"):
        bytes_ = "Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))"
        script = f"(text) => {{ const bytes = {bytes_}; return open_({kind}); }}"
        assert engine.page.evaluate(script, base64.b64encode(part_file).decode()) is None
        stats = engine.stats()
        assert len(part_file) >= stats["received"] > stats["firstPictureBytes"] > 0.5 * len(part_file)
        assert (engine.picture(camera) == wanted).all()


def test_opening_again_replaces_the_scene(engine, sample, wide):
    first, second = sample.select(slice(0, 3000)), sample.select(slice(3000, 3500))
    engine.open(encode(first, EncodeOptions(preset="fast", tile_splats=500)))
    data = encode(second, FAST)
    engine.picture(wide)
    error = engine.page.evaluate(
        "([one, two]) => { const first = open_(one); return open_(two).then(() => first); }",
        [engine.site.url("/scene.csplat"), engine.site.add("/second.csplat", data)],
    )
    assert "E_SUPERSEDED" == error["code"]
    assert psnr(engine.picture(wide), reference(decode(data), wide)) >= GOOD
    assert len(second) == engine.stats()["splatCount"]
    assert [] == engine.page.evaluate("errors")


def test_a_damaged_file_is_refused_and_the_next_is_shown(engine, part_file, camera):
    damaged = bytearray(part_file)
    damaged[len(part_file) * 3 // 4] ^= 4
    error = engine.open(bytes(damaged))
    assert "E_CRC" == error["code"]
    told = engine.page.evaluate("errors[0]")
    assert {**error, "fatal": True, "clause": "CHK-1"} == told
    assert told["offset"] > 0
    assert "E_TRUNCATED" == engine.open(part_file[:-100])["code"]
    assert "E_INPUT" == engine.page.evaluate("open_", engine.site.url("/absent.csplat"))["code"]
    engine.tab.problems.clear()  # the missing file
    assert engine.open(part_file) is None
    assert psnr(engine.picture(camera), reference(decode(part_file), camera)) >= GOOD


def test_the_picture_returns_after_the_loss_of_the_gpu(engine, part_file, camera):
    engine.open(part_file)
    before = engine.picture(camera)
    engine.page.evaluate("void (window.lose = engine.renderer.gl.getExtension('WEBGL_lose_context')).loseContext()")
    engine.page.wait_for_function("errors.length")
    assert ["E_CONTEXT", False] == engine.page.evaluate(ERRORS)[0]
    engine.page.evaluate("lose.restoreContext()")
    engine.page.wait_for_function("!engine.renderer.gl.isContextLost() && engine.opening.isDone")
    assert (engine.picture(camera) == before).all()


@pytest.fixture
def gpu_engine(remade):
    return lambda backend="webgpu-tiles": remade(f"{{ backend: '{backend}' }}")


@pytest.mark.parametrize(("backend", "least"), [("webgpu-tiles", 57), ("webgpu-quads", 55)])
def test_webgpu_draws_as_the_rasteriser_does(gpu_engine, part, camera, backend, least):
    engine = gpu_engine(backend)
    assert "(WebGPU, " in engine.page.evaluate("engine.renderer.capabilities.name")
    for preset in ("fast", "balanced"):
        model = opened(engine, part, EncodeOptions(preset=preset))
        picture = engine.picture(camera, (0.2, 0.6, 0.4))
        assert psnr(picture, reference(model, camera, (0.2, 0.6, 0.4))) >= least
        np.testing.assert_array_equal(picture, engine.picture(camera, (0.2, 0.6, 0.4)))
    assert psnr(engine.picture(camera, degree=1), reference(model, camera, sh_degree=1)) >= least


def test_webgpu_draws_pictures_that_exceed_its_buffers(gpu_engine, sample):
    engine = gpu_engine()
    engine.open(encode(sample, FAST))
    camera = view(sample, 80)
    whole = engine.picture(camera)
    tiles = math.ceil(camera.W / 16) * math.ceil(camera.H / 16)
    for most in (256 * tiles, 256 * tiles * 2 // 5):  # a block of splats in all, and in 2 of 5 rows of screen tiles
        engine.page.evaluate(f"void (engine.renderer.tiles.pairsWanted = engine.renderer.tiles.pairsMax = {most})")
        assert psnr(whole, engine.picture(camera)) >= GOOD
    assert engine.page.evaluate("engine.renderer.tiles.steps") > 1


@pytest.mark.parametrize("backend", ["webgpu-tiles", "webgpu-quads"])
def test_webgpu_draws_more_splats_than_its_records_hold(gpu_engine, part_file, camera, backend):
    engine = gpu_engine(backend)
    engine.open(part_file)
    whole = engine.picture(camera)
    engine.page.evaluate("void (engine.renderer.projection.recordsMax = 256)")
    engine.open(part_file)
    np.testing.assert_array_equal(whole, engine.picture(camera))
    assert engine.page.evaluate("engine.renderer.projection.slices.length") > 4


def test_more_splats_of_one_depth_than_webgpu_holds_are_refused(gpu_engine):
    engine = gpu_engine()
    engine.page.evaluate("void (engine.renderer.projection.recordsMax = 256)")
    engine.look(in_front(size=128))
    assert engine.open(encode(make(np.zeros((300, 3))), FAST)) is None
    engine.page.wait_for_function("errors.length")
    assert ["E_LIMIT"] == engine.page.evaluate("errors.map(({ code }) => code)")


def test_webgpu_chooses_how_to_blend_when_the_scene_is_complete(gpu_engine, part_file, camera):
    engine = gpu_engine("webgpu")
    engine.open(part_file)
    assert psnr(engine.picture(camera), reference(decode(part_file), camera)) >= GOOD
    isChosen = "(({ isChosen, quads, tiles }) => [isChosen, !!quads.picture, !!tiles.target])(engine.renderer)"
    assert engine.page.evaluate(isChosen) in ([True, True, False], [True, False, True])


def test_software_is_not_chosen_but_draws_correctly(engine):
    assert "(WebGPU" not in engine.page.evaluate("engine.renderer.capabilities.name")
    found = engine.page.evaluate(
        """async () => {
          const { WebGpuRenderer } = await import('/tools/viewer/webgpu.mjs');
          const { Device } = await import('/tools/viewer/webgpu_device.mjs');
          const { isSound } = await import('/tools/viewer/trial_scene.mjs');
          const renderer = new WebGpuRenderer(await Device.open(false), 'auto');
          const found = [await isSound(renderer)];
          renderer.projection.setView = () => {}; // a GPU that does not draw
          found.push(await isSound(renderer));
          renderer.dispose();
          return [...found, await Device.open(true)];
        }"""
    )
    assert [True, False, None] == found


def test_webgpu_returns_after_the_loss_of_the_gpu(gpu_engine, part_file, camera):
    engine = gpu_engine()
    engine.open(part_file)
    before = engine.picture(camera)
    engine.page.evaluate("void (window.lost = engine.renderer).device.device.destroy()")
    engine.page.wait_for_function("engine.renderer !== lost && engine.opening.isDone")
    assert ["E_CONTEXT", False] == engine.page.evaluate(ERRORS)[0]
    np.testing.assert_array_equal(before, engine.picture(camera))


def test_without_webgpu_webgl_2_draws(engine, remade, part_file, camera):
    engine.page.evaluate("void (navigator.gpu.requestAdapter = async () => null)")
    remade('{ backend: "webgpu" }').open(part_file)
    assert psnr(engine.picture(camera), reference(decode(part_file), camera)) >= GOOD
    assert "(WebGPU" not in engine.stats()["glRenderer"]
    engine.page.evaluate("delete navigator.gpu.requestAdapter")


def test_too_many_splats_for_the_gpu_are_refused(engine, part, part_file):
    room = engine.page.evaluate("engine.renderer.capabilities.splatsMax")
    engine.page.evaluate("void (engine.renderer.capabilities.splatsMax = 1500)")
    assert "E_LIMIT" == engine.open(part_file)["code"]
    assert engine.open(encode(part.select(slice(0, 900)), FAST)) is None
    engine.page.evaluate(f"void (engine.renderer.capabilities.splatsMax = {room})")


def test_nothing_is_left_after_closing(engine, sample):
    engine.open(encode(sample.select(slice(0, 500)), FAST))
    engine.picture(in_front(size=64))
    engine.page.evaluate("window.gl = engine.renderer.gl; window.scene = engine.renderer.scene; engine.close()")
    left = "[gl.isTexture(scene.first.texture), gl.isTexture(scene.store.linear.texture), engine.renderer.scene]"
    assert [False, False, None] == engine.page.evaluate(left)
    engine.start()


@pytest.mark.parametrize(("policy", "expected"), [
    ("", {"compiled": True, "workers": 2}),
    ("script-src 'self' 'unsafe-inline'; worker-src 'none'", {"compiled": False, "workers": 0}),
], ids=["WebAssembly", "JavaScript"])  # fmt: skip
def test_decodes_every_vector(tab, site, policy, expected):
    results = []

    def take(route):
        results.append(route.request.post_data_json)
        route.fulfill(json={"more": False})

    site.policy = policy
    site.add("/expected", json.dumps(expected).encode())
    tab.page.route("**/result", take)
    with tab.page.expect_response("**/result", timeout=120_000):
        tab.page.goto(site.url("/codec/js/test/browser.html"))
    (result,) = results
    assert [] == result["failures"]
    assert result["count"] > 700
    tab.problems.clear()  # the browser reports what the policy forbids
