"""The Python module of SPZ's repository on top of csplat, for its own tests of our reader, writer and rotations.

`test_format_spz.py` runs them, and lists which fail: functions without a counterpart in csplat are absent here.
"""

from dataclasses import replace
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from checked import checked

from csplat.editing.transform import axes_rotation, convert_axes, rotate_scene
from csplat.errors import CsplatError
from csplat.formats import write
from csplat.model import SplatModel, normalise_quats
from csplat.scene_source import source_from_model

_AXES = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU"
CoordinateSystem = Enum("CoordinateSystem", f"UNSPECIFIED {_AXES}")
globals().update(CoordinateSystem.__members__)
UNSPECIFIED, RUB, RDF = CoordinateSystem["UNSPECIFIED"], CoordinateSystem["RUB"], CoordinateSystem["RDF"]
_QUARTER = axes_rotation("RUF", "RBU")  # between the two families of axes


class PackOptions:
    version, from_coord = 4, UNSPECIFIED
    sh1_bits, sh_rest_bits = 5, 4  # ignored: ours are 6 bits


class UnpackOptions:
    to_coord = UNSPECIFIED


def _flat(name, zeros=0):
    """Return a property of flat float32 values: `zeros` zeros per splat if nothing was assigned."""
    return property(
        lambda cloud: cloud.arrays.get(name, np.zeros(zeros and zeros * cloud.num_points, np.float32)),
        lambda cloud, values: cloud.arrays.update({name: np.array(values, np.float32)}),
    )


class GaussianCloud:
    """Return a model; rotations are x y z w of any length, alphas are logits."""

    positions, scales, rotations = _flat("positions"), _flat("scales", 3), _flat("rotations", 4)
    alphas, colors, sh = _flat("alphas", 1), _flat("colors", 3), _flat("sh")
    num_points = property(lambda self: len(self.positions) // 3)

    def __init__(self):
        self.arrays, self.sh_degree, self.antialiased = {}, 0, False

    def convert_coordinates(self, before, after):
        """A quarter turn and flips apart, as its library does them: quaternions then are the same up to their sign."""
        matrix = axes_rotation(before.name, after.name)
        steps = [matrix]
        if not matrix[1, 1]:
            there = before.name[1] in "UD"
            steps = [_QUARTER, matrix @ _QUARTER.T] if there else [_QUARTER @ matrix, _QUARTER.T]
        model = replace(_model(self, before), flat=True)  # so that axes of splats are not permuted
        for step in steps:
            model = rotate_scene(model, step)
        lengths = np.linalg.norm(self.rotations.reshape(-1, 4), axis=1, keepdims=True)
        self.positions, self.sh = model.means.ravel(), model.shN.ravel()
        self.rotations = (model.quats[:, [1, 2, 3, 0]] * lengths).ravel()

    def rotate_180_deg_about_x(self):
        self.convert_coordinates(RUB, RDF)


def _model(cloud, axes):
    return SplatModel(
        means=cloud.positions.reshape(-1, 3),
        quats=normalise_quats(cloud.rotations.reshape(-1, 4)[:, [3, 0, 1, 2]]),
        scales=cloud.scales.reshape(-1, 3),
        opacities=1 / (1 + np.exp(-cloud.alphas)),
        sh0=cloud.colors.reshape(-1, 3),
        shN=cloud.sh.reshape(cloud.num_points, (cloud.sh_degree + 1) ** 2 - 1, 3),
        coordinate_system=axes.name,
        antialiased=cloud.antialiased,
    )


def _cloud(model, axes):
    if axes is not UNSPECIFIED:
        model = rotate_scene(model, axes_rotation(model.coordinate_system, axes.name))
    cloud = GaussianCloud()
    cloud.sh_degree, cloud.antialiased = model.sh_degree, model.antialiased
    cloud.positions, cloud.scales, cloud.colors = model.means.ravel(), model.scales.ravel(), model.sh0.ravel()
    cloud.rotations, cloud.sh = model.quats[:, [1, 2, 3, 0]].ravel(), model.shN.ravel()
    with np.errstate(divide="ignore"):
        cloud.alphas = np.log(model.opacities / (1 - model.opacities))
    return cloud


def _saved(cloud, axes, usual, filename, format):
    try:
        model = _model(cloud, usual if axes is UNSPECIFIED else axes)
        write(filename, convert_axes(source_from_model(model), usual.name).model(), format)
    except (CsplatError, OSError):
        return False
    return True


def save_spz(cloud, options, filename):
    format = {3: "spz", 4: "spz4"}.get(options.version)
    return format is not None and _saved(cloud, options.from_coord, RUB, filename, format)


def save_splat_to_ply(cloud, options, filename):
    return _saved(cloud, options.from_coord, RDF, filename, "ply")


def save_spz_to_buffer(cloud, options):
    with TemporaryDirectory() as folder:
        save_spz(cloud, options, Path(folder, "a.spz"))
        return Path(folder, "a.spz").read_bytes()


def load_spz(file, options):
    try:
        return _cloud(checked(file), options.to_coord)
    except (CsplatError, OSError):
        return GaussianCloud()


load_spz_from_buffer = load_splat_from_ply = load_spz


def has_extension_support():
    return True
