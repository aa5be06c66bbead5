# SPDX-License-Identifier: Apache-2.0
"""The unmodified pseudo-code of the spec against the decoder's vectorised functions."""

import itertools
import math
import zlib

import numpy as np
import pytest
from checked import covariances, rotations

from csplat import _spec
from csplat.decoder.blocks import ColumnBlock, morton_axes
from csplat.decoder.entropy import _undo_run_length, undo_transforms
from csplat.decoder.reconstruct import lattice_rows, opacity_table, write_colour, write_lattice, write_quats
from csplat.spherical_harmonics import evaluate_sh
from csplat_authoring.coders import Deflate
from csplat_conformance.tolerance import describe_deviation, is_valid_bound


def test_transforms_are_undone_from_the_last_to_the_first(spec):
    for width in range(1, 9):
        top, rng = 2 ** (8 * width), np.random.default_rng(width)
        values = [0, 1, 2, top - 1, top - 2, top // 2, top // 2 - 1, top // 2 + 1, 0, top - 1]
        values += [int.from_bytes(rng.bytes(width), "little") for _ in range(50)]
        data, count = b"".join(value.to_bytes(width, "little") for value in values), len(values)
        joined = spec.undo_byte_planes(data, count, width)
        for transforms, expected in {
            b"\0\0\0\0": values,
            b"\1\0\0\0": spec.undo_delta(values, width),
            b"\2\0\0\0": spec.undo_zigzag(values, width),
            b"\3\0\0\0": joined,
            b"\1\2\3\0": spec.undo_delta(spec.undo_zigzag(joined, width), width),
        }.items():
            assert expected == undo_transforms(data, transforms, count, width).tolist()


def test_run_length(spec):
    data = bytes([7, 8, 9]) + bytes([0, 255, 2]) + bytes([0, 255, 1])
    expected = spec.undo_run_length(data)
    assert 1 + 65536 + 259 == len(expected)
    assert expected == _undo_run_length(data, len(expected), 0).tobytes()


def test_morton(spec):
    rng = np.random.default_rng(0)
    codes = [0, 1, 2, 4, 2**51 - 1, 2**50, 2**49, 2**48, *(int(c) for c in rng.integers(0, 2**51, 200))]
    found = morton_axes(np.array(codes, np.uint64))
    assert [spec.morton_axes(code) for code in codes] == found.T.tolist()


def record(attribute, mapping, chroma_shift=0, levels=0, step=1.0):
    return _spec.AttributeRecord(attribute, mapping, chroma_shift, 0, levels, step)


def columns(rows, exponent=0):
    """Return [n][C] integers as a block; wide ones are an offset plus elements."""
    return ColumnBlock(np.array(rows, np.int64).T, (0,) * len(rows[0]), exponent, 0)


def test_colour_lifting(spec):
    for shift, bound in itertools.product((0, 1, 5, 15, 16), (0, 1, 127, 2**13, 2**15, 2**31, 2**50)):
        rng, chroma = np.random.default_rng(shift), bound >> shift
        signs = np.array([[1, -1, 1], [-1, 1, 1], [1, 1, -1], [-1, -1, -1]])
        rows = (signs * [bound, chroma, chroma]).tolist()
        luma, others = rng.integers(-bound, bound + 1, (20, 1)), rng.integers(-chroma, chroma + 1, (20, 2))
        rows += np.hstack([luma, others]).tolist()
        colour = record(_spec.ATTRIBUTE_SH0, _spec.MAPPING_YCOCG, chroma_shift=shift)
        ((_, _, parts),) = lattice_rows(columns(rows), colour, len(rows))
        expected = [list(spec.rgb_from_ycocg(*row, shift)) for row in rows]
        assert expected == np.concatenate(parts).T.tolist()


@pytest.mark.parametrize(
    ("step", "exponent"),
    [(1.0, 0), (0.1, 0), (0.1, -3), (1e-30, 0), (2.0**-1022, 0), (1e300, -2000), (2.0**-1022, 1100), (1e-12, 5)],
)
def test_lattice_values_of_means(spec, step, exponent):
    wide = 2**24 + 1, 2**31, -(2**49) + 1
    integers = [0, 1, -1, 2, 3, -3, 255, *wide, *np.random.default_rng(1).integers(-999, 999, 90).tolist()]
    with np.errstate(over="ignore"):
        expected = {n: spec.lattice_value(n, step, exponent) for n in integers}
    kept = [n for n in integers if np.isfinite(expected[n])]
    out = np.empty((len(kept), 3), np.float32)
    means = record(_spec.ATTRIBUTE_MEANS, 0, step=step)
    assert max(kept) == write_lattice(columns([[n] * 3 for n in kept], exponent), means, out)
    assert np.array([expected[n] for n in kept], np.float32).tobytes() == out[:, 1].tobytes()


@pytest.mark.parametrize(
    ("step", "exponent"), [(1.0, 0), (0.1, 0), (0.1, -3), (1e-30, 0), (2.0**-126, 0), (1e30, -220), (2.0**-126, 200)]
)
def test_values_of_scales_and_colours_are_products_in_binary32(spec, step, exponent):
    step = float(np.float32(step))
    integers = [0, 1, -1, 3, 2**22, -(2**22), *np.random.default_rng(1).integers(-(2**22), 2**22, 999).tolist()]
    expected = np.array([spec.lattice_value(n, step, exponent) for n in integers], np.float32)
    single = np.array(integers, np.float32) * np.float32(math.ldexp(step, exponent))
    out = np.empty((len(integers), 3), np.float32)
    write_lattice(columns([[n] * 3 for n in integers], exponent), record(_spec.ATTRIBUTE_SCALES, 0, step=step), out)
    assert expected.tobytes() == single.tobytes() == out[:, 1].tobytes()


def test_bands_are_laid_out_by_channel_then_coefficient(spec):
    rows = np.random.default_rng(2).integers(-2000, 2000, (30, 15)).tolist()
    out = np.empty((30, 5, 3), np.float32)
    write_colour(columns(rows), record(_spec.ATTRIBUTE_SH2, 0, step=0.015625), out)
    expected = np.array([[spec.lattice_value(n, 0.015625, 0) for n in row] for row in rows])
    np.testing.assert_array_equal(expected.reshape(30, 3, 5).transpose(0, 2, 1), out)


def test_opacities(spec):
    for levels in (1, 2, 3, 63, 255, 256, 65535):
        for mapping, by_definition in (("LINEAR", spec.opacity_linear), ("SQUARE", spec.opacity_square)):
            table = opacity_table(record(1, getattr(_spec, f"MAPPING_{mapping}"), levels=levels, step=0.0))
            for q in {0, 1, levels // 2, levels - 1, levels, *range(0, levels, 997)}:
                assert by_definition(q, levels) == table[q]
            assert (0.0, 1.0) == (table[0], table[-1])


def test_quats(spec):
    for levels in (3, 4, 127, 255, 32767):
        rows = [[0, 0, 0], [levels, levels, 0], [-levels, 0, levels], [1, -1, levels]]
        rows += np.random.default_rng(levels).integers(-levels, levels + 1, (100, 3)).tolist()
        rows = [row for row in rows if 2 * levels**2 >= sum(q * q for q in row)]
        out = np.empty((len(rows), 4), np.float32)
        write_quats(columns(rows), record(3, _spec.MAPPING_UNIT_W, levels=levels, step=0.0), out)
        expected = np.array([spec.quat(*row, levels) for row in rows], np.float32)
        assert expected.tobytes() == out.tobytes()


def test_nearness(spec):
    zero, tiny, normal, one, largest = 0, 1, 0x00800000, 0x3F800000, 0x7F7FFFFF
    starts = [zero, tiny, normal, normal + 3, one, one - 1, 0x35800000, 0x01000000, 0x2EDBE6FF, largest - 2]
    others = np.random.default_rng(1).integers(0, 2**31 - 2**24, 10).tolist()
    exact = np.array([start + sign for start in starts for sign in (0, 2**31)] + others, np.uint32).view(np.float32)
    exact = exact[np.isfinite(exact)]
    arrays, steps = ("means", "scales", "sh0", "shN", "opacities", "quats"), (-4, -3, -2, -1, 0, 1, 2, 3, 5, 16, 17)
    for array, step in itertools.product(arrays, (*steps, -(2**24), 2**31)):
        values = (exact.view(np.uint32).astype(np.int64) + step).astype(np.uint32).view(np.float32)
        for y, x in zip(values, exact, strict=True):
            far = describe_deviation(array, y.tobytes(), np.array([x]))
            assert spec.is_near(y, x, array) == (not far), (array, y, x, far)


def test_permitted_declared_errors(spec):
    # SER-7
    for measure, reach, error in itertools.product(
        ("means", "covariance", "opacities", "sh0", "sh3"), (0.0, 3.0, 5e6), (0.0, 1e-12, 1e-7, 3e-3, 0.5, 1e6)
    ):
        for wide in (0.0, 1e-13, 1e-9, 1.9e-7, 2.1e-7, 1.9e-6, 2.1e-6, 9e-5 * error, 1.1e-4 * error, error):
            for declared in (error - wide, error + wide):
                allowed = spec.may_be_declared(declared, error, measure, reach)
                assert allowed == is_valid_bound(measure, declared, error, reach)
                assert not (allowed and error > 1e-3 and abs(declared - error) > 0.002 * error)


def test_the_sh_basis(spec):
    directions = np.random.default_rng(4).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose([spec.sh_basis(*one) for one in directions], evaluate_sh(4, directions), atol=1e-13)


def test_colours_there_and_back(spec):
    rng = np.random.default_rng(4)
    for k in (0, 1, 2, 5):
        bounds = np.array([0.5 + 5 / 12 * 2**k, 0.5 + 2**k / 3, 0.5 + 5 / 12 * 2**k]) if k else 7 / 6
        for rgb in rng.uniform(-300, 300, (100, 3)):
            found = spec.rgb_from_ycocg(*spec.ycocg_from_rgb(*rgb.tolist(), k), k)
            assert (np.abs(found - rgb) <= bounds + 1e-9).all()
    for rgb in rng.integers(-300, 300, (100, 3)).tolist():
        assert tuple(rgb) == spec.rgb_from_ycocg(*spec.ycocg_from_rgb(*rgb, 0), 0)


def test_rotations_there_and_back(spec):
    rng = np.random.default_rng(0)
    quats = rng.normal(0, 1, (80, 4))
    quats[4:40] = 1 + rng.normal(0, 0.02, (36, 4))  # about w = ½, where all four are equal
    quats[:4] = [[0, 0, 1, 1], [-1, 0, 0, 0], [1, -1, 1, -1], [0, 1, 0, -1]]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    for quat in quats:
        turned = spec.with_w_largest(*quat.tolist())
        assert turned[0] == max(map(abs, turned))
        # One half turn about an axis of the splat, or none: the axes are the same up to their signs.
        before, after = rotations([quat, turned])
        np.testing.assert_allclose(np.abs(before.T @ after), np.eye(3), atol=1e-12)
        for levels in (3, 4, 5, 127, 32767):
            q = spec.quat_integers(turned, levels)
            assert max(map(abs, q)) <= levels
            assert sum(v * v for v in q) <= 2 * levels**2
            assert np.linalg.norm(np.array(spec.quat(*q, levels), np.float64) - turned) < 2.0 / levels


def test_axes_are_exchanged_with_their_scales(spec):
    rng = np.random.default_rng(6)
    quats = rng.normal(0, 1, (50, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    for quat, scales in zip(quats, rng.normal(0, 1, (50, 3)), strict=True):
        turned, ordered = spec.with_scales_sorted(quat.tolist(), scales.tolist())
        assert sorted(scales.tolist(), reverse=True) == ordered
        before, after = covariances(np.array([quat, turned]), np.array([scales, ordered]))
        np.testing.assert_allclose(after, before, atol=1e-12)


def reads(stream):
    try:
        return zlib.decompressobj(-15).decompress(stream.literals(256).end()) == b"\7"
    except zlib.error:
        return False


@pytest.mark.slow
def test_codes_are_allowed_where_zlib_reads_them(spec):
    for lengths in map(list, itertools.product(range(5), repeat=4)):
        numbered, literals = dict(enumerate(lengths)), dict(zip((7, 8, 255, 256), lengths, strict=True))
        stream = Deflate().dynamic({7: 1, 256: 1}, numbered, counts=(257, 4)).literals(7)
        assert spec.is_allowed(lengths, "distance") == reads(stream), lengths
        if literals[256]:  # COD-7
            stream = Deflate().dynamic(literals, {}, 0).literals(256).fixed().literals(7)
            assert spec.is_allowed(lengths, "literal/length") == reads(stream), lengths
        if lengths[0] and lengths[1]:  # else there is no block to write with them
            stream = Deflate().dynamic({7: 1, 256: 1}, {}, meta=numbered).literals(7)
            assert spec.is_allowed(lengths, "code length") == reads(stream), lengths
