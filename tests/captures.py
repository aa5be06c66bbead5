"""A small scene and images of it, for tests of training, tuning and searches. Requires the extra [render]."""

import json
import math
from dataclasses import replace

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from csplat import write_ply
from csplat.model import SplatModel, normalise_quats
from csplat_render import render
from csplat_render.camera import intrinsics, look_at, resized
from csplat_render.scorer import renderer
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.target_encoding import encode_to
from csplat_tools.views import BLACK, ViewSet, camera_sequence, find_view_set, with_validation_views
from csplat_trainer.posed_images import PosedImage

W, H = 48, 40


def cameras(count):
    K, angles = intrinsics(W, H, 60.0), np.linspace(0.2, 5.9, count)
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0), (0, 0, 1), K, W, H) for a in angles]


def views_of(seen_from, photographs=()):
    """Return training views and every eighth as a validation view, without test views."""
    return with_validation_views(ViewSet("cameras", BLACK, seen_from, (), (), photographs))


def shell(coefficients):
    """Return 300 overlapping splats on a sphere with smoothly varying colours; `coefficients` of SH beyond degree 0."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((300, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return SplatModel(
        means=means.astype(np.float32),
        quats=normalise_quats(rng.standard_normal((300, 4))),
        scales=rng.uniform(-2.5, -1.3, (300, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.95, 300).astype(np.float32),
        sh0=(np.sin(3.0 * means) + 0.5).astype(np.float32),
        shN=(0.1 * rng.standard_normal((300, coefficients, 3))).astype(np.float32),
    )


def photograph(scene, folder):
    """Write sixteen images on black, and a PLY with an additional splat far behind all cameras."""
    (folder / "images").mkdir()
    frames = []
    for number, camera in enumerate(cameras(16)):
        pixels = np.clip(render(scene, camera).rgb, 0.0, 1.0)
        Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(folder / "images" / f"view{number:02}.png")
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/view{number:02}.png", "transform_matrix": pose.tolist()})
    K = intrinsics(W, H, 60.0)
    document = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": W / 2, "cy": H / 2, "w": W, "h": H, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    hidden = scene.select(np.concatenate([[0], np.arange(len(scene))]))
    hidden = replace(hidden, means=np.concatenate([np.full((1, 3), 400.0, np.float32), scene.means]))
    write_ply(folder / "scene.ply", hidden)
    return folder


def as_colmap(folder):
    """Replace the poses of such a folder by COLMAP's files."""
    (folder / "transforms.json").unlink()
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    K, lines = cameras(1)[0].K, []
    for number, camera in enumerate(cameras(16)):
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
        values = " ".join(str(value) for value in (w, x, y, z, *camera.viewmat[:3, 3]))
        lines.append(f"{number + 1} {values} 1 view{number:02}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "cameras.txt").write_text(f"1 PINHOLE {W} {H} {K[0, 0]} {K[1, 1]} {W / 2} {H / 2}\n")
    return folder


def photograph_object(scene, folder):
    """Write a Blender set of sixteen transparent images, twelve of them for training."""
    for part, seen_from in (("train", cameras(16)[1:13]), ("test", [*cameras(16)[:1], *cameras(16)[13:]])):
        (folder / part).mkdir()
        frames = []
        for number, camera in enumerate(seen_from):
            seen = render(scene, camera)
            straight = np.clip(seen.rgb / np.maximum(seen.alpha, 1e-6)[..., None], 0.0, 1.0)
            pixels = np.concatenate([straight, seen.alpha[..., None]], axis=2)
            Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(folder / part / f"r_{number}.png")
            pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append({"file_path": f"./{part}/r_{number}", "transform_matrix": pose.tolist()})
        angle = 2.0 * math.atan(W / 2 / cameras(1)[0].K[0, 0])
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


SMALL = (32, 24)  # pixels of a view; a search then takes a second


def crowded():
    """Return a shell and 600 nearly invisible splats."""
    rng, scene = np.random.default_rng(1), shell(3)
    faint = {
        "means": (0.5 * rng.standard_normal((600, 3))).astype(np.float32),
        "quats": np.tile(np.array([1, 0, 0, 0], np.float32), (600, 1)),
        "scales": np.full((600, 3), -4.0, np.float32),
        "opacities": np.full(600, 0.02, np.float32),
        "sh0": np.zeros((600, 3), np.float32),
        "shN": np.zeros((600, 3, 3), np.float32),
    }
    return SplatModel(**{name: np.concatenate([getattr(scene, name), array]) for name, array in faint.items()})


def around(source, count=24):
    """Return small virtual views of a scene."""
    views = find_view_set(source, count=count, size=SMALL)
    test, validation = ([resized(camera, 48, 36) for camera in part] for part in (views.test, views.validation))
    return replace(views, test=test, validation=validation)


def judged_by(seen_from):
    """Return training views, and every fourth as a test view."""
    training = [camera for number, camera in enumerate(seen_from) if number % 4]
    return ViewSet("cameras", BLACK, training, (), seen_from[::4])


def photographed(scene):
    """Return views with images that differ from the scene by 25 dB; every eighth is a test view."""
    seen_from = camera_sequence(scene, 48, SMALL, seed=3)
    rng, draw = np.random.default_rng(1), renderer(scene, BLACK)
    noisy = [np.clip(draw(c).rgb + 0.06 * rng.standard_normal((c.H, c.W, 3)), 0, 1) for c in seen_from]
    pictures = [PosedImage(c, np.rint(255.0 * p).astype(np.uint8)) for c, p in zip(seen_from, noisy, strict=True)]
    training = [camera for number, camera in enumerate(seen_from) if number % 8]
    return ViewSet("made", BLACK, training, (), seen_from[::8], pictures)


def found_within(source, views=None, encoding=None, *, no_prune=False, importance=None, refit=True, **goal):
    """Return the file at a target by a brief search in small views, by default of forty cameras."""
    views = views or judged_by(cameras(40))
    # Larger views take fewer steps of a fit. The size only matters if virtual views are added.
    size = SMALL if views.virtual else (960, 720)
    simplifying = SimplifyOptions(effort=1, rounds=2, view_size=size, refit=refit)
    chosen = {"no_prune": no_prune, "importance": importance, "simplifying": simplifying}
    return encode_to(source, views=views, options=encoding, **chosen, **goal)
