# SPDX-License-Identifier: Apache-2.0
"""Tiny data sets of each kind on disk: a few cameras that look at three dots."""

import json
import re
import struct

import numpy as np
import pytest
from checked import quaternion_of
from PIL import Image

from csplat.errors import InputError
from csplat_render.camera import intrinsics, look_at, relative_to
from csplat_trainer.data import load

W, H = 48, 32
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
POINTS = np.array([[0.05, 0.03, -0.04], [0.4, 0.1, 0.2], [-0.3, 0.2, -0.1]])
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]])


def cameras(count, width=W, height=H, up=(0, 0, 1)):
    K = intrinsics(width, height, 50.0)
    angles = np.linspace(0.3, 5.0, count)
    above = np.array(up, np.float64)
    first = np.roll(above, 1)
    places = [3 * (np.cos(a) * first + np.sin(a) * np.cross(above, first)) + above for a in angles]
    return [look_at(place, [0, 0, 0], above, K, width, height) for place in places]


def write_picture(path, camera, mode="RGB", scale=1):
    """Write a black image with a dot at the projection of each point."""
    width, height = camera.W // scale, camera.H // scale
    pixels = np.zeros((height, width, len(mode)), np.uint8)
    for point, colour in zip(POINTS, COLOURS, strict=True):
        pixels[pixel_of(camera, point, scale)] = [*colour, 255][: len(mode)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels, mode).save(path)


def pixel_of(camera, point, scale=1):
    c = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    u, v = (camera.K @ (c / c[2]))[:2] / scale
    return int(v), int(u)


def assert_dots_are_where_points_fall(pictures, points=POINTS):
    for picture in pictures:
        for point, colour in zip(points, COLOURS, strict=True):
            assert (picture.pixels[pixel_of(picture.camera, point)][:3] == colour).all()


def assert_refused(message, folder, **options):
    with pytest.raises(InputError, match=message):
        load(folder, **options)


def report_of(folder, **options):
    """Return the lines that a set reports, as one text."""
    return "\n".join(load(folder, **options).report)


def sizes(data):
    """Return the numbers of training, validation and test images."""
    return len(data.train), len(data.val), len(data.test)


def names(pictures):
    return [picture.camera.image for picture in pictures]


def to_opengl(camera):
    return (np.linalg.inv(camera.viewmat) @ FLIP).tolist()


def write_blender(folder, up=(0, 0, 1)):
    for part, count in (("train", 5), ("test", 3)):
        frames = []
        for i, camera in enumerate(cameras(count, up=up)):
            write_picture(folder / part / f"r_{i}.png", camera, "RGBA")
            frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": to_opengl(camera)})
        document = {"camera_angle_x": float(np.radians(50.0)), "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(document))
    return folder


def write_transforms(folder, missing=(), up=(0, 0, 1), at=(0, 0, 0)):
    frames = []
    for i, camera in enumerate(cameras(10, up=up)):
        if i not in missing:
            write_picture(folder / "images" / f"{i:04}.png", camera)
        pose = np.array(to_opengl(camera))
        pose[:3, 3] += at
        frames.append({"file_path": f"images/{i:04}.png", "transform_matrix": pose.tolist()})
    write_document(folder, intrinsics(W, H, 50.0), W, H, frames)
    return folder


def write_document(folder, K, width, height, frames):
    document = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**document, "frames": frames}))


MODELS = {"PINHOLE": 1, "FULL_OPENCV": 6}


def write_colmap(folder, shots, model="PINHOLE", parameters=None, text=False, width=W, height=H, at=(0, 0, 0)):
    """Write a sparse model of cameras and the three points, with coordinates around `at`."""
    shots, points = [relative_to(np.negative(at), one) for one in shots], POINTS + at
    folder.mkdir(parents=True, exist_ok=True)
    K = shots[0].K
    parameters = parameters or [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    poses = [(*quaternion_of(c.viewmat[:3, :3]), *c.viewmat[:3, 3]) for c in shots]
    names = [f"im {i:03}.png" for i in range(len(shots))]
    if text:
        words = " ".join(str(float(p)) for p in parameters)
        (folder / "cameras.txt").write_text(f"# comment\n7 {model} {width} {height} {words}\n")
        lines = ["# comment\n# another\n"]
        for i, (pose, name) in enumerate(zip(poses, names, strict=True)):
            lines.append(f"{i + 1} {' '.join(map(str, pose))} 7 {name}\n{'1.5 2.5 -1' if i % 2 else ''}\n")
        (folder / "images.txt").write_text("".join(lines))
        colours = zip(points, COLOURS, strict=True)
        rows = [f"{i} {' '.join(map(str, (*p, *c)))} 0.5 1 0 2 0\n" for i, (p, c) in enumerate(colours)]
        (folder / "points3D.txt").write_text("# comment\n" + "".join(rows))
        return
    data = struct.pack("<QiiQQ", 1, 7, MODELS[model], width, height) + struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(shots))
    for i, (pose, name) in enumerate(zip(poses, names, strict=True)):
        data += struct.pack("<i7di", i + 1, *pose, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", i) + struct.pack("<ddq", 1.0, 2.0, -1) * i
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for i, (point, colour) in enumerate(zip(points, COLOURS, strict=True)):
        data += struct.pack("<Q3d3BdQ", i, *point, *map(int, colour), 0.5, i) + struct.pack("<ii", 1, 2) * i
    (folder / "points3D.bin").write_bytes(data)


def write_colmap_set(folder, text=False, up=(0, 0, 1), at=(0, 0, 0)):
    shots = cameras(9, up=up)
    for i, camera in enumerate(shots):
        write_picture(folder / "images" / f"im {i:03}.png", camera)
    write_colmap(folder / "sparse" / "0", shots, text=text, at=at)
    return folder


def rename_in_images_txt(folder, name):
    """Write the model again as text, with other names of the images."""
    write_colmap(folder / "sparse" / "0", cameras(9), text=True)
    for file in (folder / "sparse" / "0").glob("*.bin"):
        file.unlink()
    file = folder / "sparse" / "0" / "images.txt"
    file.write_text(re.sub(r"im (\d{3})\.png", lambda old: name(int(old[1])), file.read_text()))


def frames_of(folder):
    return json.loads((folder / "transforms.json").read_text())["frames"]


def change_transforms(folder, **changes):
    file = folder / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def change_frames(folder, numbers, **changes):
    frames = [{**frame, **changes} if i in numbers else frame for i, frame in enumerate(frames_of(folder))]
    change_transforms(folder, frames=frames)
