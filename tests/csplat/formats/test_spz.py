# SPDX-License-Identifier: Apache-2.0
"""SPZ: every version read from bytes written by hand; damaged files are refused."""

import gzip
import struct
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
import zstandard
from checked import assert_damage_is_refused_or_read, checked
from formats_cases import same

import csplat
from csplat.errors import InputError
from csplat.formats import format_by_name, read_scene, write_levels
from csplat.scene import Scene

WIDTHS = {1: (6, 1, 3, 3, 3), 2: (9, 1, 3, 3, 3), 3: (9, 1, 3, 3, 4), 4: (9, 1, 3, 3, 4)}
AXES = struct.pack("<IIII", 0xABCD0001, 4, 7, 0xADBE0003) + struct.pack("<II", 4, 6)


def spz(version, parts, *, degree=0, bits=8, flags=0, count=None, extensions=b"", bare=False):
    """Return a file of an SPZ version with these bytes of positions, alphas, colours, scales, rotations and SH."""
    count = len(parts[1]) if count is None else count
    head = struct.pack("<4sIIBBB", b"NGSP", version, count, degree, bits, flags)
    if version < 4:
        whole = head + b"\0" + b"".join(parts) + extensions
        return whole if bare else gzip.compress(whole, mtime=0)
    packed = [zstandard.compress(part) for part in parts if part]
    sizes = zip(packed, filter(None, parts), strict=True)
    table = b"".join(struct.pack("<QQ", len(small), len(part)) for small, part in sizes)
    return head + struct.pack("<BI12x", len(packed), 32 + len(extensions)) + extensions + table + b"".join(packed)


def splats(version, count=2, degree=0):
    """Return the bytes of random splats."""
    rng = np.random.default_rng(version)
    widths = (*WIDTHS[version], 3 * ((degree + 1) ** 2 - 1))
    parts = [rng.integers(0, 256, count * width, np.uint8).tobytes() for width in widths]
    return [bytes(len(parts[0])), *parts[1:]] if version == 1 else parts


def word(index, *three):
    """Pack three components of a rotation, in units of sqrt(1/2) / 511; `index` is the omitted one of x y z w."""
    fields = [abs(one) | (512 if one < 0 else 0) for one in three]
    return struct.pack("<I", index << 30 | fields[0] << 20 | fields[1] << 10 | fields[2])


@pytest.mark.parametrize(("version", "positions", "rotation", "bare"), [
    (1, np.array([1.5, -2.0, 0.25], "<f2").tobytes(), bytes([255, 0, 0]), False),
    (2, bytes([128, 1, 0, 0, 254, 255, 64, 0, 0]), bytes([255, 0, 0]), True),
    (2, bytes([128, 1, 0, 0, 254, 255, 64, 0, 0]), bytes([255, 0, 0]), False),
    (3, bytes([128, 1, 0, 0, 254, 255, 64, 0, 0]), word(3, 511, -511, 0), False),
    (4, bytes([128, 1, 0, 0, 254, 255, 64, 0, 0]), word(0, 511, 0, -511), False),
])  # fmt: skip
def test_each_version_is_read(version, positions, rotation, bare):
    data = [positions, b"\x33", bytes([0, 51, 255]), bytes([0, 160, 255]), rotation, bytes([0, 128, 255] * 3)]
    model = checked(spz(version, data, degree=1, flags=1, bare=bare))
    assert [[1.5, -2.0, 0.25]] == model.means.tolist()
    assert [[-10.0, 0.0, 5.9375]] == model.scales.tolist()
    assert [[-1.0, 0.0, 127 / 128]] * 3 == model.shN[0].tolist()
    assert model.opacities == np.float32(0.2)
    np.testing.assert_allclose([[-0.5 / 0.15, -0.3 / 0.15, 0.5 / 0.15]], model.sh0, rtol=1e-6)
    half = sqrt(0.5)
    wanted = {3: [0, half, -half, 0], 4: [-half, 0, half, 0]}.get(version, [0, sqrt(1 / 3), -sqrt(1 / 3), -sqrt(1 / 3)])
    np.testing.assert_allclose([wanted], model.quats, atol=4e-4)  # the root of a rounding error
    assert ("RUB", True) == (model.metadata.coordinate_system, model.metadata.antialiased)


def test_the_omitted_component_of_a_rotation_is_restored():
    three = [sqrt(0.5) / 511 * value for value in (73, 146, -219)]
    for largest in range(4):
        model = checked(spz(3, [bytes(9), b"\1", bytes(3), bytes(3), word(largest, 73, 146, -219)]))
        xyzw = [*three[:largest], sqrt(1 - np.square(three).sum()), *three[largest:]]
        np.testing.assert_allclose([xyzw[3], *xyzw[:3]], model.quats[0], atol=1e-6)


def test_gzip_members_are_joined_and_a_file_may_have_no_splats():
    data = spz(3, splats(3), bare=True)
    whole = checked(spz(3, splats(3)))
    for model in (checked(data), checked(gzip.compress(data[:50]) + gzip.compress(data[50:]))):
        same(whole, model)
    assert 0 == len(checked(spz(4, [b""] * 6, degree=3))) == len(checked(spz(3, [b""] * 6, degree=3)))


@pytest.mark.parametrize("version", [3, 4])
def test_the_axes_extension_is_read_and_others_are_skipped(version):
    def axes(extensions=AXES, flags=2):
        return checked(spz(version, splats(version), flags=flags, extensions=extensions)).metadata.coordinate_system

    assert ("RDF", "RUB") == (axes(), axes(flags=0))
    with pytest.raises(InputError, match="axes number 17"):
        axes(AXES[:-4] + bytes([17, 0, 0, 0]))


def test_version_4_stores_degree_4_and_version_3_leaves_its_band_out(tmp_path, make_model):
    model = make_model(40, 4)
    model = replace(model, shN=model.shN.clip(-0.9, 0.9))
    for name, coefficients in (("spz4", 24), ("spz", 15)):
        csplat.write(tmp_path / "a.spz", model, name)
        found = csplat.read(tmp_path / "a.spz").shN
        assert (40, coefficients, 3) == found.shape
        assert np.abs(model.shN[:, :coefficients] - found).max() <= 2.01 / 128
        assert (name == "spz") == ("SH band 4" in format_by_name(name).losses(Scene.of(model)))


def test_bytes_after_the_splats_are_reported(tmp_path):
    def found(data):
        (tmp_path / "a.spz").write_bytes(data)
        return [(one.id, one.count) for one in read_scene(tmp_path / "a.spz").findings]

    whole = spz(3, splats(3))
    assert [] == found(whole) == found(spz(3, splats(3), flags=2, extensions=AXES[12:]))
    assert [("other-elements", 1)] == found(spz(3, splats(3), flags=2, extensions=AXES))
    assert [("trailing-bytes", len(gzip.decompress(whole)))] == found(whole + whole)
    assert [("trailing-bytes", 2)] == found(spz(2, splats(3)))  # version 2 has one byte less per splat


@pytest.mark.parametrize(("data", "message"), [
    (spz(4, splats(4, degree=4), degree=5), "SH degree 5, expected at most 4"),
    (struct.pack("<4sI40x", b"NGSP", 5), "version 5"),
    (gzip.compress(spz(4, splats(4)), mtime=0), "version 4, expected 1 to 4"),
    (gzip.compress(b"NGSX" + bytes(40), mtime=0), "begins with b'NGSX'"),
    (spz(3, splats(3), bits=31), "31 fractional bits"), (spz(3, splats(3), flags=0x80), "levels of detail"),
    (spz(3, splats(3), count=2**32 - 1), "4,294,967,295 splats, too many"),
    (spz(4, splats(4), count=3), r"streams of \[18, 2, 6, 6, 8\] bytes, expected \[27, 3, 9, 9, 12\]"),
    (spz(4, [bytes(n * (1 << 22)) for n in (9, 1, 3, 3, 4)]), "4,194,304 splats, too many"),
    (spz(4, splats(4)) + b"\0", "its table declares"),
    (spz(3, splats(3), extensions=bytes(1 << 21)), "bytes after its last splat"),
    (spz(1, [b"\xff\xff" * 3, b"\1", bytes(3), bytes(3), bytes(3)]), "NaN or infinite"),
])  # fmt: skip
def test_invalid_or_oversized_files_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        csplat.read(data, "spz")


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3, 4])
def test_a_damaged_file_is_refused_or_read(tmp_path, version):
    whole = spz(version, splats(version, degree=1), degree=1, flags=2, extensions=AXES)
    sizes, places = (*range(0, len(whole), 5), len(whole) - 1), range(0, len(whole), 2)
    assert_damage_is_refused_or_read(tmp_path / "a.spz", whole, sizes, places, checked)


def fields(path):
    """Return version, count, degree, fractional bits and flags of a file."""
    data = path.read_bytes()
    return struct.unpack_from("<IIBBB", gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data, 4)


@pytest.mark.parametrize(("name", "version"), [("a.spz", 3), ("a.v4.spz", 4)])
def test_written_files_read_back_within_half_a_step(tmp_path, make_model, name, version):
    model = make_model(200, 3, coordinate_system="RUB", antialiased=True)
    model = replace(model, shN=np.clip(model.shN / 3, -1, 0.97), sh0=np.clip(model.sh0, -3, 3))
    csplat.write(tmp_path / name, model)
    assert (version, 200, 3, 12, 1) == fields(tmp_path / name)
    found = checked(tmp_path / name)
    steps = {"means": 2**-12, "scales": 1 / 16, "opacities": 1 / 255, "sh0": 1 / 38.25, "shN": 1 / 32}
    for array, step in steps.items():
        np.testing.assert_allclose(getattr(found, array), getattr(model, array), atol=step / 2 + 1e-6, rtol=0)
    turned = 2 * np.arccos(np.minimum(1, np.abs(np.einsum("ij,ij->i", found.quats.astype(float), model.quats))))
    assert np.degrees(turned.max()) < 0.3
    csplat.write(tmp_path / f"again.{name}", found)
    assert (tmp_path / name).read_bytes() == (tmp_path / f"again.{name}").read_bytes()


def test_values_beyond_the_range_are_clipped(tmp_path, make_model):
    fields = {"sh0": [9, -9, 0], "scales": [-30, 30, 0], "shN": np.full((3, 3), [2, -2, 0.99]).tolist()}
    fields = {name: np.array([value] * 2, "f4") for name, value in fields.items()}
    model = make_model(2, 1, opacities=np.array([0, 1], "f4"), coordinate_system="RUB", **fields)
    csplat.write(tmp_path / "a.spz", model)
    found = checked(tmp_path / "a.spz")
    assert [-10, 5.9375, 0] == found.scales[0].tolist()
    assert [0, 1] == found.opacities.tolist()
    assert [127 / 128, -1, 127 / 128] == found.shN[0, 0].tolist()
    np.testing.assert_allclose(found.sh0[0, :2], [0.5 / 0.15, -0.5 / 0.15], rtol=1e-6)


def test_a_size_beyond_float64_is_reported(tmp_path, make_model):
    model = make_model(1, scales=np.array([[710, 0, 0]], "f4"))
    findings = csplat.write(tmp_path / "a.spz", model)
    (text,) = (one.text for one in findings if one.attribute == "scales")
    assert "(a size of inf becomes 379 scene units)" in text


def test_the_step_of_positions_fits_splats_and_extent(tmp_path, make_model):
    def bits(reach, scale):
        means = np.linspace(-reach, reach, 30, dtype="f4").reshape(10, 3)
        csplat.write(tmp_path / "a.spz", make_model(10, 0, means=means, scales=np.full((10, 3), scale, "f4")))
        number = fields(tmp_path / "a.spz")[3]
        np.testing.assert_allclose(checked(tmp_path / "a.spz").means * [1, -1, -1], means, atol=2.0**-number / 2)
        return number

    scenes = [(1, 0), (2047, 0), (1, -7.5), (2049, 0), (8e6, 0), (500, -9), (0, 0)]
    assert [12, 12, 16, 11, 0, 14, 12] == [bits(*one) for one in scenes]
    with pytest.raises(InputError, match="positions reach 9e\\+06, SPZ stores up to 8,388,607"):
        bits(9e6, 0)


def test_a_scene_without_axes_is_written_as_rdf(tmp_path, make_model):
    model = make_model(5, 3, means=np.arange(15, dtype="f4").reshape(5, 3))
    csplat.write(tmp_path / "a.spz", model)
    found = checked(tmp_path / "a.spz")
    assert (model.means * [1, -1, -1]).tolist() == found.means.tolist()
    flips = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1]  # signs for flipped y and z, by coefficient
    np.testing.assert_allclose(np.clip(model.shN * np.c_[flips], -1, 127 / 128), found.shN, atol=1 / 64)
    csplat.write(tmp_path / "b.spz", make_model(5, 3, means=model.means, coordinate_system="RDF"))
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


@pytest.mark.parametrize("name", ["a.spz", "a.v4.spz"])
def test_the_preset_small_has_fewer_bits_of_sh_and_of_fine_positions(tmp_path, make_model, name):
    model = make_model(300, 3, coordinate_system="RUB", scales=np.full((300, 3), -7.5, "f4"))
    model = replace(model, shN=np.clip(model.shN / 4, -0.9, 0.9))
    write_levels(tmp_path / name, [Scene.of(model)])
    whole = (tmp_path / name).stat().st_size
    write_levels(tmp_path / name, [Scene.of(model)], preset="small")
    assert 12 == fields(tmp_path / name)[3]
    assert (tmp_path / name).stat().st_size < 0.85 * whole
    found = checked(tmp_path / name).shN
    for band, half in ((slice(0, 3), 1 / 32), (slice(3, 15), 1 / 16)):
        worst = np.abs(found[:, band] - model.shN[:, band]).max()
        assert half / 2 < worst <= half + 1e-6
    with pytest.raises(InputError, match="SPZ cannot be written with the preset fast"):
        write_levels(tmp_path / "a.spz", [Scene.of(model)], preset="fast")
