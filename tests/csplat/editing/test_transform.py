# SPDX-License-Identifier: Apache-2.0
"""The up axis: read, estimated and kept; scenes in other coordinates; everything that shows a scene agrees on up.

Also: csplat_render.up_estimate.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from checked import cloud, covariances, sh_by_definition

from csplat import decode, encode, write_ply
from csplat.editing.transform import (
    axes_rotation,
    convert_axes,
    rotate_scene,
    scale_scene,
    stretch_scene,
    translate_scene,
)
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat.scene import Scene
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_paths import orbit_cameras
from csplat_render.up_estimate import estimate_up, with_estimated_up
from csplat_tools.cli.shared_options import parse_up, up_word
from csplat_tools.views import display_cameras, find_view_set
from csplat_trainer.data.loader import estimate_up_of_cameras

pytest.importorskip("PIL", reason="training requires the extra [render]")


def test_up_survives_ply_and_csplat_files_unless_it_is_invalid(tmp_path, make_model):
    path, up = tmp_path / "a.ply", {"up": [0.0, -0.995037, 0.099504]}
    write_ply(path, make_model(entries={"up": [0, -1, 0.1]}))
    data = path.read_bytes()
    first = decode(encode(read_ply(path)))
    write_ply(path, first)
    assert up == first.metadata.entries == decode(encode(read_ply(path))).metadata.entries
    write_ply(path, make_model(entries={"up": "there"}))
    assert {} == read_ply(path).metadata.entries
    for words in (b"", b"0 0 0", b"1 2", b"nan 0 1", b"x y z"):
        with pytest.raises(InputError, match="csplat up"):
            read_ply(data.replace(b"\ncomment csplat up 0.0 -0.995037 0.099504\n", b"\ncomment csplat up %s\n" % words))


def photographed_from(up, **fields):
    """Make a ball of fine splats; on the side that faces away from `up`, unseen, they are few and large."""
    places = np.random.default_rng(0).standard_normal((4000, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    unseen = places @ np.array(up, float) < -0.2
    kept = ~unseen | (np.arange(4000) % 40 == 0)
    sizes = np.where(unseen, 0.3, 0.03)[kept]
    return cloud(places[kept], sizes, **fields)


@pytest.mark.slow
def test_an_object_was_photographed_from_above():
    for up in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
        assert list(up) == with_estimated_up(photographed_from(up)).metadata.entries["up"]  # what `estimate_up` returns
        assert up == parse_up(up_word(up))
    assert (0.0, pytest.approx(-0.8), pytest.approx(0.6)) == parse_up(up_word((0.0, -0.8, 0.6)))


@pytest.mark.slow
def test_no_up_is_estimated_without_evidence_or_if_one_is_recorded():
    for up in ((0, 0, 0), (0.6, 0.6, 0.6)):  # seen from all sides; between the axes
        assert estimate_up(photographed_from(up)) is None
    assert estimate_up(photographed_from((0, 0, 1)).select(np.arange(0))) is None
    for fields in ({"entries": {"up": [1, 0, 0]}}, {"coordinate_system": "RDF"}):
        model = photographed_from((0, 0, 1), **fields)
        assert estimate_up(model) is None
        assert with_estimated_up(model) is model


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_renders_for_display_are_upright_and_test_views_do_not_move():
    model = photographed_from((0, 1, 0))
    views = find_view_set(model, count=0)
    for camera in [*orbit_cameras(model, 4, 64, 48), *display_cameras(model, views)]:
        assert abs(camera.viewmat[0, 1]) < 1e-6
        assert camera.viewmat[1, 1] < 0.0  # down the picture
    assert all(camera.viewmat[1, 1] > 0.0 for camera in views.test)  # -y is up, as in a PLY without metadata
    assert "up" not in decode(encode(model)).metadata.entries  # nor is an estimate recorded


@pytest.mark.parametrize(("name", "up"), [("donut", (0, 0, 1)), ("horse", None)])
def test_the_estimate_is_right_for_real_objects(data_dir, name, up):
    assert up == estimate_up(read_ply(data_dir / "ply" / f"{name}.ply"))


LEVEL_K = intrinsics(64, 48, 60.0)
UP = np.array([0.6, -0.8, 0.0])


def rolled(viewmat, degrees):
    """Roll a camera about its viewing direction."""
    a, turn = np.radians(degrees), np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return turn @ viewmat


def around(count, *, pitch=0.0, spread=360.0, rolls=0.0):
    """Yield nearly level cameras that look outwards, `pitch` degrees below the horizon."""
    first, rng = np.array([0.0, 0.0, 1.0]), np.random.default_rng(0)
    second = np.cross(UP, first)
    for a in np.radians(np.linspace(0.0, spread, count, endpoint=False)):
        ahead = np.cos(a) * first + np.sin(a) * second - np.tan(np.radians(pitch)) * UP
        yield rolled(look_at([0, 0, 0], ahead, UP, LEVEL_K, 64, 48).viewmat, rolls * rng.standard_normal())


def degrees_off(level):
    return float(np.degrees(np.arccos(np.clip(np.sum(np.array(level.up) * UP), -1.0, 1.0))))


def test_pitch_does_not_change_the_estimate():
    for pitch in (-40.0, 0.0, 40.0, 70.0, 89.0):
        level = estimate_up_of_cameras(list(around(12, pitch=pitch)))
        assert level.by_horizons
        assert max(level.tilt_degrees, degrees_off(level)) < 0.01


def test_rolls_and_views_to_one_side_move_the_estimate_little():
    level = estimate_up_of_cameras(list(around(5, spread=10.0, pitch=5.0)))
    assert not level.by_horizons  # but the mean of their own up
    assert 4.0 < degrees_off(level) < 6.0
    level = estimate_up_of_cameras(list(around(60, rolls=6.0)))
    assert degrees_off(level) < 3.0
    assert 2.0 < level.tilt_degrees < 6.0
    portrait = [rolled(one, 90.0 * (number % 5 == 0)) for number, one in enumerate(around(60))]
    assert degrees_off(estimate_up_of_cameras(portrait)) < 2.0
    rng = np.random.default_rng(1)
    viewmats = [look_at([0, 0, 0], *rng.standard_normal((2, 3)), LEVEL_K, 64, 48).viewmat for _ in range(40)]
    assert estimate_up_of_cameras(viewmats) is None  # cameras at random angles


ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
FLIPS = [np.diag(signs) for signs in product((1.0, -1.0), repeat=3)]
WHOLE = [flips @ np.eye(3)[list(order)] for order in permutations(range(3)) for flips in FLIPS]
ANY = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
CAMERA = {"K": [[50.0, 0, 30], [0, 50.0, 20], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 64, "H": 48, "near": 0.1}


def shapes(model):
    return covariances(model.quats, model.scales)


def colours(model, directions):
    """Return the SH colour of every splat in every direction, without degree 0."""
    basis = sh_by_definition(4, directions)[:, 1:]
    return np.einsum("dk,nkc->ndc", basis[:, : model.shN.shape[1]], model.shN.astype(np.float64))


@pytest.mark.parametrize("matrix", [*WHOLE[::9], ANY, -ANY])
def test_rotation_turns_shapes_and_colours(make_model, matrix):
    model = make_model(20, 3, flat=True)
    after = rotate_scene(model, matrix)
    directions = np.random.default_rng(1).standard_normal((30, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert np.abs(model.means @ matrix.T - after.means).max() < 1e-6
    assert np.abs(matrix @ shapes(model) @ matrix.T - shapes(after)).max() < 1e-6
    assert np.abs(colours(model, directions) - colours(after, directions @ matrix.T)).max() < 2e-6
    assert (model.scales[:, 2] == after.scales[:, 2]).all()  # the third scale of a disc has no meaning


@pytest.mark.parametrize("matrix", [ANY @ np.diag([0.5, 2.0, 1.0]), [[-3, 0, 0], [1, 1, 0], [0, 0, 2]], 2.0 * ANY])
def test_a_linear_map_transforms_covariances(make_model, matrix):
    model = make_model(20, 1, origin=(1.0, 2.0, 3.0))
    after = stretch_scene(model, matrix)
    expected = np.dot(matrix, shapes(model)).swapaxes(0, 1) @ np.transpose(matrix)
    assert np.abs(expected - shapes(after)).max() < 1e-6
    world = np.dot(model.means + model.origin, np.transpose(matrix))
    assert np.abs(world - after.means - after.origin).max() < 1e-5


@pytest.mark.parametrize("degree", [0, 3])
def test_changing_axes_and_back_is_exact(make_model, degree):
    model = make_model(20, degree, origin=(1.0, -2.5, 3.0))
    model.means[0] = (0.0, -0.0, 1e-45)
    for matrix in WHOLE[::2]:
        back = rotate_scene(rotate_scene(model, matrix), matrix.T)
        exact = ARRAYS if abs(matrix[2, 2]) == 1 or degree < 2 else ARRAYS[:-1]
        assert all(getattr(model, name).tobytes() == getattr(back, name).tobytes() for name in exact)
        assert np.abs(model.shN - back.shN).max(initial=0.0) < 2e-6
        assert model.origin == back.origin
    for matrix in (ANY, -ANY):  # a rotation has two quaternions; the original one comes back
        assert np.abs(model.quats - rotate_scene(rotate_scene(model, matrix), matrix.T).quats).max() < 1e-6


def with_directions(make_model, rng, count=20):
    """Return a model with random normals and displacements by name and by semantic, and columns that do not turn."""
    extra = {
        "normal": rng.standard_normal((count, 3)).astype("f4"),
        "facing": rng.standard_normal((count, 3)),
        "motion": rng.standard_normal((count, 3 * int(rng.integers(1, 4)))).astype("f4"),
        "flow": rng.standard_normal((count, 3)).astype("f4"),
        "other": rng.standard_normal((count, 3)).astype("f4"),
        "label": rng.integers(0, 9, count).astype("i4"),
    }
    extra["normal"][0] = 0.0  # no normal
    return make_model(count, 1, extra=extra, semantics={"facing": "normal", "flow": "motion", "other": "feature:x"})


def assert_turned(model, changed, linear, atol=1e-5):
    """Check the columns of `with_directions` against their definitions under a linear map."""
    inverse = np.linalg.inv(linear)
    for name, column in model.extra.items():
        expected = column
        if name in ("motion", "flow"):
            expected = (column.reshape(-1, 3) @ linear.T).reshape(column.shape)
        elif name in ("normal", "facing"):
            expected = column @ inverse
            lengths = np.linalg.norm(expected, axis=1, keepdims=True)
            expected = expected / np.maximum(lengths, 1e-30) * np.linalg.norm(column, axis=1, keepdims=True)
        assert column.dtype == changed.extra[name].dtype
        np.testing.assert_allclose(changed.extra[name], expected, rtol=1e-5, atol=atol)
    assert model.metadata.semantics == changed.metadata.semantics


def test_normals_and_displacements_change_with_the_scene(make_model):
    rng = np.random.default_rng(5)
    for _ in range(25):
        model = with_directions(make_model, rng)
        rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]  # every other one mirrors
        factor, matrix = float(rng.uniform(0.1, 9)), rng.standard_normal((3, 3)) + 2 * np.eye(3)
        assert_turned(model, rotate_scene(model, rotation), rotation)
        assert_turned(model, scale_scene(model, factor), factor * np.eye(3))
        assert_turned(model, translate_scene(model, (1.0, 2.0, 3.0)), np.eye(3))
        assert_turned(model, stretch_scene(model, factor * rotation), factor * rotation, 1e-4)
        assert_turned(model, stretch_scene(model, matrix), matrix, 1e-4)
    for axes in ("".join(signed) for one in permutations(("RL", "UD", "FB")) for signed in product(*one)):
        there = convert_axes(Scene.of(replace(model, metadata=replace(model.metadata, coordinate_system="RDF"))), axes)
        assert_turned(model, there.model(), axes_rotation("RDF", axes))
        back = convert_axes(there, "RDF").model()
        for name, column in model.extra.items():
            assert (column == back.extra[name]).all()  # exact, as for the means
    far = replace(model, extra={"motion": np.full((20, 3), 3e38, "f4")})
    with pytest.raises(InputError, match="'motion' exceeds float32"):
        scale_scene(far, 10.0)


def test_columns_whose_type_does_not_suit_their_semantic_stay(make_model):
    extra = {"normal": np.ones((9, 2), "f4"), "motion": np.ones((9, 4), "f4"), "bent": np.ones((9, 3), "i1")}
    model = make_model(9, 0, extra=extra, semantics={"bent": "normal"})
    for changed in (rotate_scene(model, axes_rotation("RDF", "UFR")), scale_scene(model, 2.0)):
        assert all((changed.extra[name] == column).all() for name, column in extra.items())


def test_axis_letters_up_and_cameras_follow_a_rotation(make_model):
    model = make_model(3, 0, coordinate_system="RDF", cameras=[CAMERA], entries={"view": CAMERA, "up": [0, 0, 1]})
    assert "LUF" == rotate_scene(model, axes_rotation("RDF", "LUF")).metadata.coordinate_system
    for axes in ("RUB", "FRD", "UFL", "LDF"):
        after = rotate_scene(model, axes_rotation("RDF", axes))
        assert axes == after.metadata.coordinate_system
        assert tuple(axes_rotation("RDF", axes)[:, 2]) == after.metadata.up
        for camera in (after.metadata.cameras[0], after.metadata.entries["view"]):
            view, mirrored = np.array(camera["viewmat"]), np.linalg.det(axes_rotation("RDF", axes)) < 0
            assert 1.0 == np.linalg.det(view)
            assert (34 if mirrored else 30) == camera["K"][0][2]
            seen = np.array([-1, 1, 1] if mirrored else [1, 1, 1]) * (view[:3, :3] @ axes_rotation("RDF", axes))
            assert (seen == np.eye(3)).all()
    named = rotate_scene(make_model(3, 0, coordinate_system="RDF"), ANY)
    assert "unspecified" == named.metadata.coordinate_system
    assert np.abs(-ANY[:, 1] - named.metadata.up).max() < 1e-6


@pytest.mark.parametrize(("fields", "up"), [
    ({"coordinate_system": "RFU"}, (0, 0, 1)),
    ({}, (0, -1, 0)),
    ({"entries": {"up": [0, 0, 1]}}, (0, 0, 1)),
    ({"entries": {"up": [0, 1, 0]}}, (0, 1, 0)),
    ({"entries": {"up": [0.1, -1, 0.2]}}, (0.1, -1, 0.2)),
])  # fmt: skip
def test_converted_axes_put_up_where_the_format_expects_it(make_model, fields, up):
    model = make_model(5, 1, **fields, origin=(1.0, 2.0, 3.0))
    scene = convert_axes(Scene.of(model), "LUF")
    after = scene.model()
    assert "LUF" == scene.metadata.coordinate_system == after.metadata.coordinate_system
    assert (0, 1, 0) == after.metadata.up
    heights = model.means @ np.array(up) / np.linalg.norm(up)
    assert np.abs(heights - after.means[:, 1]).max() < 1e-6
    assert convert_axes(scene, "LUF") is scene


def test_lengths_and_cameras_follow_a_scale_and_a_translation(make_model):
    model = make_model(5, 1, origin=(1e6, 2.0, 3.0), unit_metres=2.0, cameras=[CAMERA], entries={"view": CAMERA})
    doubles = model.means + np.array(model.origin)
    model = replace(model, means_double=doubles, means=(doubles - model.origin).astype(np.float32))
    for after, factor, offset in (
        (scale_scene(model, 0.5), 0.5, 0.0),
        (translate_scene(model, (0.1, 0.2, 0.3)), 1.0, (0.1, 0.2, 0.3)),
        (rotate_scene(model, np.eye(3)), 1.0, 0.0),
    ):
        assert np.abs(model.means_double * factor + offset - after.means - after.origin).max() < 1e-6
        assert np.abs(model.scales + np.log(factor) - after.scales).max() < 1e-6
        assert 2.0 / factor == after.metadata.unit_metres
        assert 0.1 * factor == after.metadata.cameras[0]["near"]
    after = translate_scene(model, (1.0, -2.0, 0.5))
    # Their rotation is the identity, as in `CAMERA`.
    for camera in (after.metadata.cameras[0], after.metadata.entries["view"]):
        assert np.allclose(model.means, after.means + np.array(camera["viewmat"])[:3, 3], atol=1e-5)


def test_invalid_transforms_are_refused(make_model):
    for matrix in (np.ones((3, 3)), np.eye(4), 2 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="expected an orthogonal matrix"):
            rotate_scene(make_model(2, 0), matrix)
    with pytest.raises(InputError, match="expected a number above 0"):
        scale_scene(make_model(2, 0), -1.0)
    with pytest.raises(InputError, match="one each of"):
        axes_rotation("RDF", "XYZ")
