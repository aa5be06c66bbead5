"""A small scene, and photographs of it, for tests of what learns from photographs. Wants the extra [render]."""

import json
from dataclasses import replace

import numpy as np
from PIL import Image

from csplat import write_ply
from csplat.model import SplatModel, normalise_quats
from csplat_render import render
from csplat_render.cameras import intrinsics, look_at
from csplat_tools.views import BLACK, ViewSet, with_deciders

W, H = 48, 40


def cameras(count):
    K, angles = intrinsics(W, H, 60.0), np.linspace(0.2, 5.9, count)
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0), (0, 0, 1), K, W, H) for a in angles]


def views_of(seen_from, photographs=()):
    """Views of which every eighth decides and the others teach; none judges."""
    return with_deciders(ViewSet("cameras", BLACK, seen_from, (), (), photographs))


def shell(coefficients):
    """300 overlapping splats on a sphere, whose colours vary smoothly, with so many SH coefficients above degree 0."""
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
    """Write a PLY with one splat more, far behind all cameras, and sixteen photographs in front of black."""
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
    hidden = scene.select(np.concatenate([[0], np.arange(300)]))
    hidden = replace(hidden, means=np.concatenate([np.full((1, 3), 400.0, np.float32), scene.means]))
    write_ply(folder / "scene.ply", hidden)
    return folder
