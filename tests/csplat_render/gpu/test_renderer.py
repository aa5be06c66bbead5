# SPDX-License-Identifier: Apache-2.0
"""The renderer on a GPU, by an adapter that emulates one, and the layout that its shaders read.

Tests of the area need wgpu (extra `gpu`) and a Vulkan driver; Debian's mesa-vulkan-drivers has one for the CPU.

Also: csplat_render.gpu.device, csplat_render.gpu.scoring.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from oracle import GROUPS, VIEW, adversarial, extreme_splats, facing, random_splats
from tables import failures

import csplat
from csplat.decoder import iter_packed, iter_tiles
from csplat.errors import InputError, LimitError
from csplat_bench.protocol import Setup
from csplat_bench.subjects.gpu_rendering import STAGES, measure_gpu
from csplat_conformance.manifest import VECTORS
from csplat_render import render
from csplat_render.conventions import UncheckedSplats
from csplat_render.gpu import device as devices
from csplat_render.gpu.packing import BLOCK
from csplat_render.gpu.renderer import GpuRenderer, GpuScene
from csplat_render.gpu.scoring import compare_scenes
from csplat_render.metrics import psnr
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras


def area(test):
    """Mark a test that needs an adapter."""
    return pytest.mark.gpu(pytest.mark.usefixtures("device")(test))


LEAST_PSNR = 74.0  # dB, of any scene against the rasteriser on the CPU
EXTREME = UncheckedSplats(**extreme_splats())


@pytest.fixture(scope="module")
def device():
    try:
        return devices.open_device(software=True)
    except InputError as error:
        pytest.skip(f"{error}: install wgpu and mesa-vulkan-drivers")


@pytest.fixture(scope="module")
def sample(sample_path):
    """The sample scene, its file with codebooks, and a view."""
    model = csplat.read(sample_path)
    return model, csplat.encode(model, csplat.EncodeOptions(preset="balanced")), virtual_cameras(model)[0]


def on_device(model, view, **options):
    return render(model, view, backend="software", **options)


def assert_same(model, view, found=None, least=LEAST_PSNR, **options):
    """Compare a render, by default of the same splats on the device, with that of the rasteriser."""
    wanted, found = render(model, view, **options), found or on_device(model, view, **options)
    assert psnr(wanted.rgb, found.rgb) >= least
    assert psnr(np.repeat(wanted.alpha[..., None], 3, 2), np.repeat(found.alpha[..., None], 3, 2)) >= least
    assert wanted.ignored == found.ignored


def values_of(packed):
    return (packed.integers.astype(np.float64) * packed.step).astype(np.float32)


def bands_of(tile, count):
    """Return the SH coefficients of a packed tile."""
    values = np.zeros((len(tile.opacities), count, 3), np.float32)
    for band, packed in tile.bands.items():
        rows = values_of(packed.rows)
        if packed.table is not None:
            rows = np.concatenate([values_of(packed.table), rows])[packed.index]
        values[:, band * band - 1 : (band + 1) ** 2 - 1] = rows
    return values


def test_packed_tiles_have_the_values_of_decoded_ones():
    files = [path for path in sorted(VECTORS.rglob("valid/*.csplat")) if path.stat().st_size < 1 << 14][::4]
    kinds = set()
    for path in files:
        for tile, packed in zip(iter_tiles(path), iter_packed(path), strict=True):
            for name in ("means", "scales", "sh0"):
                np.testing.assert_array_equal(getattr(tile, name), values_of(getattr(packed, name)))
            np.testing.assert_array_equal(tile.shN, bands_of(packed, tile.shN.shape[1]))
            alpha = (packed.opacities / packed.opacity_levels) ** (1 + packed.opacities_squared)
            np.testing.assert_allclose(tile.opacities, alpha, rtol=1e-6)
            scaled = packed.quats / (packed.quat_levels * np.sqrt(2.0))
            np.testing.assert_allclose(tile.quats[:, 1:], scaled, rtol=1e-6, atol=1e-9)
            kinds |= {(packed.opacities_squared, *(band.table is not None for band in packed.bands.values()))}
    assert len(kinds) > 4


def test_the_shaders_have_the_constants_of_the_rasteriser():
    from csplat_render import conventions, metrics

    folder = Path(__file__).resolve().parents[3] / "codec" / "wgsl"
    text = "\n".join(path.read_text(encoding="utf-8") for path in folder.glob("*.wgsl"))
    for name in ("ALPHA_MIN", "ALPHA_CAP", "TRANSMITTANCE_MIN", "DILATION", "COMPENSATION_MIN"):
        found = float(text.partition(f"const {name} = ")[2].partition(";")[0])
        assert getattr(conventions, name) == pytest.approx(found, rel=1e-12)
    assert f"const COVERED_ALPHA = {metrics.COVERED_ALPHA};" in text


@area
@pytest.mark.parametrize("count", [1, 255, 4096, 4097, 20_000])
def test_the_sort_is_stable(device, count):
    rng = np.random.default_rng(count)
    keys = rng.integers(0, 1 << 31, count, dtype=np.uint32)
    keys[rng.random(count) < 0.5] = 77
    renderer = GpuRenderer(GpuScene(device, [UncheckedSplats(**extreme_splats(count=1))]))
    buffers = [device.uploaded(keys), device.buffer(4 * count)]
    values = [device.buffer(4 * count) for _ in range(2)]
    device.upload(renderer._counters, np.array([count, 0, 0, 0], np.uint32))
    device.upload(renderer._groups, np.array([-(-count // 4096), 1, 1], np.uint32))
    device.run(renderer._passes_of_sort(buffers, values, 32, 0, of_pairs=False))
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(keys[order], device.read(buffers[0], 4 * count).view(np.uint32))
    np.testing.assert_array_equal(order, device.read(values[0], 4 * count).view(np.uint32))


@area
@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (1, False), (2, True), (3, False), (4, True)])
def test_renders_of_models_agree_with_the_rasteriser(degree, antialiased):
    model = UncheckedSplats(**random_splats(500, degree, seed=degree))
    assert_same(model, VIEW, background=(0.2, 0.5, 0.9), antialiased=antialiased)


@area
def test_renders_of_files_agree_with_the_rasteriser(device, sample):
    model, data, view = sample
    for preset in ("fast", "balanced", "small"):
        coded = csplat.encode(model, csplat.EncodeOptions(preset=preset))
        with csplat.open(coded) as file:
            renderer = GpuRenderer(GpuScene(device, [file]))
        found = renderer.render(view)
        assert_same(csplat.decode(coded), view, found)
        np.testing.assert_array_equal(found.rgb, renderer.render(view).rgb)
    with csplat.open(data) as file:
        assert_same(csplat.decode(data, sh_degree=1), view, on_device(file, view, sh_degree=1))
        np.testing.assert_array_equal(render(csplat.decode(data), view).rgb, render(file, view).rgb)


@area
def test_adversarial_splats_survive():
    def check(case):
        model, options = UncheckedSplats(**case.arrays), {"antialiased": case.antialiased}
        found = on_device(model, case.view, **options).rgb
        assert np.isfinite(found).all()
        if case.view.near > 1e-20:  # nearer than that, products leave float32
            assert psnr(render(model, case.view, **options).rgb, found) >= 50.0

    assert [] == failures(dict(adversarial()), check)


@area
def test_unusual_splats_and_sizes_agree_with_the_rasteriser():
    def check(case):
        arrays, (width, height), least = case
        assert_same(UncheckedSplats(**arrays), facing(width=width, height=height), least=least)

    sizes = ((1, 1), (16, 16), (17, 15), (1, 100), (333, 1), (8192, 40))
    cases = {f"size {size}": (extreme_splats(), size, LEAST_PSNR) for size in sizes}
    for scale in (-80.0, -20.0, 20.0, 80.0):
        cases[f"log scales {scale}"] = extreme_splats(scales=scale), (50, 37), 60.0
    for name in GROUPS:  # splats with NaN are ignored and counted
        arrays = extreme_splats(count=30)
        arrays[name].reshape(30, -1)[:3, -1] = np.nan
        cases[f"NaN in {name}"] = arrays, (50, 37), LEAST_PSNR
    equal_depth = extreme_splats(count=2, degree=0, means=0.0, opacities=0.9, scales=-1.0)
    equal_depth["sh0"][:] = [[1.7, -1.7, -1.7], [-1.7, 1.7, -1.7]]
    outlier = random_splats(500, 0, seed=3)  # costs the others no precision
    outlier["means"][7] = 1e12
    cases |= {"equal depth": (equal_depth, (50, 37), LEAST_PSNR), "an outlier": (outlier, (50, 37), LEAST_PSNR)}
    assert [] == failures(cases, check)


@area
def test_empty_and_invisible_scenes_are_the_background():
    colour = np.float32([0.1, 0.2, 0.3])
    for arrays in (extreme_splats(count=0), extreme_splats(means=(0.0, 0.0, -9.0)), extreme_splats(opacities=0.0)):
        found = on_device(UncheckedSplats(**arrays), facing(), background=colour)
        np.testing.assert_array_equal(found.rgb, np.broadcast_to(colour, found.rgb.shape))
        assert not found.alpha.any()


@area
def test_several_scenes_are_rendered_as_one(device, sample):
    model, data, view = sample
    offset = np.float32([0.3, 0.0, 0.1])
    moved = replace(model, origin=(0.3, 0.0, 0.1), means=model.means - offset)
    fine = csplat.encode(moved, csplat.EncodeOptions(preset="fast"))
    with csplat.open(data) as one, csplat.open(fine) as other:
        found = GpuRenderer(GpuScene(device, [one, other, model])).render(view)
    second = csplat.decode(fine)
    parts = (csplat.decode(data), replace(second, means=second.means + offset), model)
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in GROUPS}
    # Splats of coinciding scenes are almost equal in depth, and rounding swaps some.
    assert_same(UncheckedSplats(**arrays), view, found, least=70.0)


@area
def test_slices_and_steps_do_not_change_a_bit(device, sample):
    model, _, view = sample
    scene = GpuScene(device, [model])
    whole = GpuRenderer(scene).render(view)
    assert 1 == whole.steps
    pairs = BLOCK * -(-view.W // 16) * -(-view.H // 16)
    for limits in ({"records_max": 300}, {"pairs_max": pairs}, {"records_max": 500, "pairs_max": pairs}):
        found = GpuRenderer(scene, **limits).render(view)
        np.testing.assert_array_equal(whole.rgb, found.rgb)
        np.testing.assert_array_equal(whole.alpha, found.alpha)
        assert (whole.visible, whole.pairs) == (found.visible, found.pairs)
    bands = GpuRenderer(scene, pairs_max=pairs // 5).render(view)
    assert psnr(whole.rgb, bands.rgb) > 90.0


@area
def test_steps_beyond_float32_are_survived(device):
    with csplat.open(VECTORS / "extreme" / "step_largest_lattice_zero.csplat") as file:
        assert_same(file.read(), facing(), GpuRenderer(GpuScene(device, [file])).render(facing()))


@area
def test_pairs_that_a_driver_rounds_away_draw_nothing(device, sample, monkeypatch):
    model, _, view = sample
    scene = GpuScene(device, [model])
    whole = GpuRenderer(scene).render(view)
    source = devices.shader_source("bin")
    longer = source.replace("pair_counts[rank] = pairs;", "pairs += u32(rank % 7u == 0u); pair_counts[rank] = pairs;")
    assert longer != source
    monkeypatch.setattr(devices, "shader_source", {"bin": longer}.get)
    monkeypatch.setattr(device, "_pipelines", {key: made for key, made in device._pipelines.items() if key[0] != "bin"})
    found = GpuRenderer(scene).render(view)
    assert found.pairs > whole.pairs
    np.testing.assert_array_equal(whole.rgb, found.rgb)


@area
def test_a_renderer_survives_a_lack_of_memory(device, monkeypatch):
    renderer = GpuRenderer(GpuScene(device, [EXTREME]))
    before, make, limit = renderer.render(facing()), device.buffer, 0

    def scarce(size_bytes, **usage):
        if size_bytes >= limit:
            raise InputError("too little memory")
        return make(size_bytes, **usage)

    monkeypatch.setattr(device, "buffer", scarce)
    with pytest.raises(InputError, match="too little memory"):
        renderer.render(facing(width=200, height=200))
    limit = 4 << 20  # bytes of a quarter of the usual pairs
    np.testing.assert_array_equal(before.rgb, GpuRenderer(renderer.scene).render(facing()).rgb)
    monkeypatch.undo()
    np.testing.assert_array_equal(before.rgb, renderer.render(facing()).rgb)


@area
def test_scores_are_those_of_the_rasteriser(device, sample):
    model, data, _ = sample
    views, background = virtual_cameras(model)[:2], (0.1, 0.9, 0.4)
    decoded = replace(csplat.decode(data), origin=(0.0, 0.0, 0.0))
    wanted = Scorer.of_source(model, views, background).scores(decoded, ssim=False)
    found = compare_scenes(GpuScene(device, [model]), GpuScene(device, [decoded]), views, background)
    for name in ("psnr", "psnr_mean", "psnr_worst", "psnr_covered"):
        assert getattr(wanted, name) == pytest.approx(getattr(found, name), abs=0.01)
    assert wanted.cover == pytest.approx(found.cover, abs=1e-4)
    assert wanted.worst_view == found.worst_view


@area
def test_the_benchmark_measures_every_stage(sample_path, tmp_path):
    options = {"size": [64, 48], "views": 1, "frames": 2, "software": True}
    setup = Setup(work=tmp_path, peers=tmp_path, data=tmp_path, csplat=[], options=options)
    with measure_gpu(setup, str(sample_path), []) as measure:
        packed, floats = (measure({"layout": layout, "copies": 2}) for layout in ("packed", "floats"))
    assert packed["bytes_per_splat"] < 0.3 * floats["bytes_per_splat"]
    for row in (packed, floats):
        assert {f"{stage.replace(' ', '_')}_ms" for stage in STAGES} < set(row)
        assert row["psnr"] >= LEAST_PSNR


@area
def test_commands_take_a_backend(sample_path, tmp_path):
    coded, renders, pictures = (str(tmp_path / name) for name in ("a.csplat", "renders", "pictures"))
    call("encode", str(sample_path), coded)
    call("render", coded, renders, "--orbit", "2", "--size", "64x48", "--backend", "software", "--alpha")
    compare = ("compare", str(sample_path), coded, "--backend", "software")
    scores, all_scores = call(*compare).stdout, call(*compare, "--pictures", pictures).stdout
    assert [True, False, True] == ["psnr" in scores, "ssim" in scores, "ssim" in all_scores]
    assert [4, 8] == [len([*Path(folder).iterdir()]) for folder in (renders, pictures)]


@area
def test_a_lost_gpu_is_an_error_and_opened_again():
    before, lost = on_device(EXTREME, facing()), devices.open_device(software=True)
    renderer = GpuRenderer(GpuScene(lost, [EXTREME]))
    lost._device.destroy()
    with pytest.raises(InputError, match=r"failed: .*lost"):
        renderer.render(facing())
    np.testing.assert_array_equal(before.rgb, on_device(EXTREME, facing()).rgb)


@area
def test_what_a_gpu_cannot_do_is_refused():
    device = devices.open_device(software=True)  # opened again if a test has lost it
    scene = GpuScene(device, [EXTREME])
    one_depth = GpuScene(device, [UncheckedSplats(**extreme_splats(count=300, means=0.0, opacities=0.9))])
    for message, use in {
        "mode fast requires the backend cpu": lambda: on_device(EXTREME, facing(), mode="fast"),
        "no scenes": lambda: GpuScene(device, []),
        "quats has shape": lambda: GpuScene(device, [replace(EXTREME, quats=EXTREME.quats[:, :3])]),
        "sh_degree is -1": lambda: GpuScene(device, [EXTREME], sh_degree=-1),
        "equal depth": lambda: GpuRenderer(one_depth, records_max=256).render(facing()),
        r"pixels of a row.*\b16\b": lambda: GpuRenderer(scene, pairs_max=BLOCK).render(facing(width=100)),
    }.items():
        with pytest.raises((InputError, LimitError), match=message):
            use()
    for colour in ((0, 0), "red", (0, 0, np.nan)):
        with pytest.raises(InputError, match="background"):
            on_device(EXTREME, facing(), background=colour)
        with pytest.raises(InputError, match="background"):
            compare_scenes(scene, scene, [facing()], colour)


@pytest.mark.slow
def test_without_a_gpu_auto_warns_and_gpu_is_an_error(monkeypatch):
    def none(**_options):
        raise InputError("no GPU was found, only a toaster")

    monkeypatch.setattr(devices, "open_device", none)
    with pytest.raises(InputError, match="only a toaster: the backend cpu needs none"):
        render(EXTREME, facing(), backend="gpu")
    with pytest.warns(UserWarning, match="only a toaster: rendering on the CPU"):
        found = render(EXTREME, facing(), backend="auto")
    np.testing.assert_array_equal(render(EXTREME, facing()).rgb, found.rgb)
    with pytest.raises(InputError, match="'vulkan', expected one of cpu, gpu, auto, software"):
        render(EXTREME, facing(), backend="vulkan")
