"""Scenes in other coordinates: what is exact there and back, and that colours, shapes and cameras go along."""

from itertools import permutations, product

import numpy as np
import pytest

from csplat.editing.transform import (
    axes_rotation,
    convert_axes,
    rotate_scene,
    scale_scene,
    stretch_scene,
    translate_scene,
)
from csplat.editing.up_axis import up_of
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_source import source_from_model

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
FLIPS = [np.diag(signs) for signs in product((1.0, -1.0), repeat=3)]
WHOLE = [flips @ np.eye(3)[list(order)] for order in permutations(range(3)) for flips in FLIPS]
ANY = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
CAMERA = {"K": [[50.0, 0, 30], [0, 50.0, 20], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 64, "H": 48, "near": 0.1}


def covariances(model):
    w, x, y, z = model.quats.T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    root = np.moveaxis(np.array(rows), 2, 0) * np.exp(model.scales.astype(np.float64))[:, None]
    return root @ root.transpose(0, 2, 1)


def colours(model, directions):
    """Return the SH colour of every splat in every direction, by the formulas of INRIA's renderer."""
    x, y, z = directions.T
    basis = [
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return np.einsum("kd,nkc->ndc", basis[: model.shN.shape[1]], model.shN.astype(np.float64))


@pytest.mark.parametrize("matrix", [*WHOLE[::5], ANY, -ANY])
def test_shapes_and_colours_turn_with_their_places(make_model, matrix):
    model = make_model(20, 3, flat=True)
    after = rotate_scene(model, matrix)
    directions = np.random.default_rng(1).standard_normal((30, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert np.abs(model.means @ matrix.T - after.means).max() < 1e-6
    assert np.abs(matrix @ covariances(model) @ matrix.T - covariances(after)).max() < 1e-6
    assert np.abs(colours(model, directions) - colours(after, directions @ matrix.T)).max() < 2e-6
    assert (model.scales[:, 2] == after.scales[:, 2]).all()  # the third scale of a disc means nothing


@pytest.mark.parametrize("matrix", [ANY @ np.diag([0.5, 2.0, 1.0]), [[-3, 0, 0], [1, 1, 0], [0, 0, 2]], 2.0 * ANY])
def test_any_linear_map_takes_shapes_along(make_model, matrix):
    model = make_model(20, 1, origin=(1.0, 2.0, 3.0))
    after = stretch_scene(model, matrix)
    assert (
        np.abs(np.dot(matrix, covariances(model)).swapaxes(0, 1) @ np.transpose(matrix) - covariances(after)).max()
        < 1e-6
    )
    world = np.dot(model.means + model.origin, np.transpose(matrix))
    assert np.abs(world - after.means - after.origin).max() < 1e-5


@pytest.mark.parametrize("degree", range(4))
def test_axes_there_and_back_are_the_same_bits(make_model, degree):
    model = make_model(20, degree, origin=(1.0, -2.5, 3.0))
    model.means[0] = (0.0, -0.0, 1e-45)
    for matrix in WHOLE:
        back = rotate_scene(rotate_scene(model, matrix), matrix.T)
        exact = ARRAYS if abs(matrix[2, 2]) == 1 or degree < 2 else ARRAYS[:-1]
        assert all(getattr(model, name).tobytes() == getattr(back, name).tobytes() for name in exact)
        assert np.abs(model.shN - back.shN).max(initial=0.0) < 2e-6
        assert model.origin == back.origin
    for matrix in (ANY, -ANY):  # a rotation has two quaternions; the original one comes back
        assert np.abs(model.quats - rotate_scene(rotate_scene(model, matrix), matrix.T).quats).max() < 1e-6


def test_letters_follow_a_scene(make_model):
    model = make_model(3, 0, coordinate_system="RDF", cameras=[CAMERA], metadata={"view": CAMERA, "up": [0, 0, 1]})
    assert "LUF" == rotate_scene(model, axes_rotation("RDF", "LUF")).coordinate_system
    for axes in ("RUB", "FRD", "UFL", "LDF"):
        after = rotate_scene(model, axes_rotation("RDF", axes))
        assert axes == after.coordinate_system
        assert tuple(axes_rotation("RDF", axes)[:, 2]) == up_of(after.metadata)
        for before, camera in ((CAMERA, after.cameras[0]), (CAMERA, after.metadata["view"])):
            view, mirrored = np.array(camera["viewmat"]), np.linalg.det(axes_rotation("RDF", axes)) < 0
            assert 1.0 == np.linalg.det(view)
            assert (34 if mirrored else 30) == camera["K"][0][2]
            seen = np.array([-1, 1, 1] if mirrored else [1, 1, 1]) * (view[:3, :3] @ axes_rotation("RDF", axes))
            assert (seen == np.array(before["viewmat"])[:3, :3]).all()
    named = rotate_scene(make_model(3, 0, coordinate_system="RDF"), ANY)
    assert "unspecified" == named.coordinate_system
    assert np.abs(-ANY[:, 1] - up_of(named.metadata)).max() < 1e-6


@pytest.mark.parametrize(
    ("fields", "up"),
    [
        ({"coordinate_system": "RFU"}, (0, 0, 1)),
        ({}, (0, -1, 0)),
        ({"metadata": {"up": [0, 0, 1]}}, (0, 0, 1)),
        ({"metadata": {"up": [0, 1, 0]}}, (0, 1, 0)),
        ({"metadata": {"up": [0.1, -1, 0.2]}}, (0.1, -1, 0.2)),
    ],
)
def test_a_scene_stands_upright_in_the_axes_of_a_format(make_model, fields, up):
    model = make_model(5, 1, **fields, origin=(1.0, 2.0, 3.0))
    scene = convert_axes(source_from_model(model), "LUF")
    after = scene.model()
    assert "LUF" == scene.metadata_model.coordinate_system == after.coordinate_system
    assert (0, 1, 0) == up_of(after.metadata, "LUF")
    heights = model.means @ np.array(up) / np.linalg.norm(up)
    assert np.abs(heights - after.means[:, 1]).max() < 1e-6
    assert convert_axes(scene, "LUF") is scene


def test_lengths_change_together(make_model):
    model = make_model(5, 1, origin=(1e6, 2.0, 3.0), unit_metres=2.0, cameras=[CAMERA])
    model = SplatModel(**{**vars(model), "means_double": model.means + np.array(model.origin)})
    model = SplatModel(**{**vars(model), "means": (model.means_double - model.origin).astype(np.float32)})
    for after, factor, offset in (
        (scale_scene(model, 0.5), 0.5, 0.0),
        (translate_scene(model, (0.1, 0.2, 0.3)), 1.0, (0.1, 0.2, 0.3)),
        (rotate_scene(model, np.eye(3)), 1.0, 0.0),
    ):
        assert np.abs(model.means_double * factor + offset - after.means - after.origin).max() < 1e-6
        assert np.abs(model.scales + np.log(factor) - after.scales).max() < 1e-6
        assert 2.0 / factor == after.unit_metres
        assert 0.1 * factor == after.cameras[0]["near"]


def test_cameras_see_a_scene_where_it_was_moved_to(make_model):
    model = make_model(5, 0, cameras=[CAMERA], metadata={"view": CAMERA})
    after = translate_scene(model, (1.0, -2.0, 0.5))
    for before, now in ((CAMERA, after.cameras[0]), (CAMERA, after.metadata["view"])):
        seen = [
            one.means @ np.array(camera["viewmat"])[:3, :3].T + np.array(camera["viewmat"])[:3, 3]
            for one, camera in ((model, before), (after, now))
        ]
        assert np.allclose(*seen, atol=1e-5)


def test_refuses_what_is_no_turn(make_model):
    for matrix in (np.ones((3, 3)), np.eye(4), 2 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="wanted an orthogonal matrix"):
            rotate_scene(make_model(2, 0), matrix)
    with pytest.raises(InputError, match="wanted one above 0"):
        scale_scene(make_model(2, 0), -1.0)
    with pytest.raises(InputError, match="one each of"):
        axes_rotation("RDF", "XYZ")
