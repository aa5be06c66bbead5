# SPDX-License-Identifier: Apache-2.0
"""Helpers on models for tests: encode with everything checked, read along the axes of a format, covariances."""

import math
from dataclasses import replace

import numpy as np
from models import model_of
from numpy.polynomial import Legendre

import csplat
from csplat.disk_files import local_file
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions
from csplat.encoder.error_bounds import measured_sums
from csplat.errors import InputError
from csplat.formats import detect_format
from csplat.model import normalise_quats
from csplat_conformance.validator import validate


def encoded(model, importance=None, **options):
    result = encode_with_report(model, EncodeOptions(**options), importance=importance)
    assert () == tuple(validate(result.data).violations)
    decoded = csplat.decode(result.data)
    for name, (largest, rms) in measure_errors(model, decoded, result.source_index).items():
        assert largest <= result.report.errors[name][0], name
        assert rms <= result.report.errors[name][1], name
    return result, decoded


def measure_errors(source, decoded, source_index):
    """Return (max, rms) of a decoded model against its source, by measure of the spec."""
    return measured_sums(source, decoded, source_index).bounds()


def checked(file):
    """Read a scene along the axes of its file."""
    with local_file(file) as path, detect_format(path).open(path) as scene:
        return scene.model()


def refusals(path, cases, read=csplat.read):
    """Write each case to a file and read it; return the message of each InputError, and "" for each success."""
    messages = []
    for data in cases:
        path.write_bytes(data)
        messages.append("")
        try:
            read(path)
        except InputError as error:
            messages[-1] = str(error)
    return messages


def flipped(data, places, mask=lambda at: 1 << at % 8):
    """Yield the bytes with one of them changed by a mask, for each place."""
    for at in places:
        yield data[:at] + bytes([data[at] ^ mask(at)]) + data[at + 1 :]


def assert_damage_is_refused_or_read(path, whole, sizes, places, read=csplat.read):
    """Assert that a file is read, and that its prefixes, and flipped bytes if they matter, are refused in a line."""
    assert [""] == refusals(path, [whole], read)
    assert all(refusals(path, (whole[:size] for size in sizes), read))
    for message in refusals(path, flipped(whole, places, lambda at: 255 >> at % 7), read):
        assert not message or (path.name in message and "\n" not in message)


def cloud(means, sizes=0.03, **fields):
    """Return a scene of grey splats of alpha 0.9 at these means; a size may be infinite."""
    count, sizes = len(means), np.asarray(sizes, np.float32).reshape(-1, 1)
    arrays = {
        "means": np.asarray(means, np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        "scales": np.broadcast_to(np.log(sizes), (count, 3)).astype(np.float32),
        "opacities": np.full(count, 0.9, np.float32),
        "sh0": np.zeros((count, 3), np.float32),
    }
    return model_of(**{**arrays, **fields})


def covariances(quats, scales):
    """Return covariances [n, 3, 3] in float64 by definition, from quats of any length and logarithms of scales."""
    rotation = rotations(quats / np.linalg.norm(quats.astype(np.float64), axis=1)[:, None])
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * scales.astype(np.float64)), rotation)


def rotations(quats):
    """Return the matrices [n, 3, 3] of unit quaternions."""
    w, x, y, z = np.asarray(quats, np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternion_of(rotation):
    """Return w x y z of a rotation (Bar-Itzhack: the eigenvector of the largest eigenvalue)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    lower = np.diag([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy])
    lower[np.tril_indices(4, -1)] = zy - yz, xz - zx, yx + xy, yx - xy, zx + xz, zy + yz
    return np.linalg.eigh(lower)[1][:, -1]


def disturbed(model, rng, sigma=1e-3):
    """Return the model with normal noise on every value."""
    arrays = {name: getattr(model, name) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    arrays = {name: (a + rng.normal(0, sigma, a.shape)).astype(np.float32) for name, a in arrays.items()}
    arrays |= {"quats": normalise_quats(arrays["quats"]), "opacities": np.clip(arrays["opacities"], 0, 1)}
    return replace(model, **arrays)


def sh_by_definition(degree, directions):
    """Return the real SH basis [D, (degree + 1)**2] in unit directions [D, 3], by associated Legendre functions."""
    x, y, z = directions.T
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            legendre = Legendre.basis(band)
            value = (-1.0) ** m * (1.0 - z * z) ** (m / 2) * (legendre.deriv(m) if m else legendre)(z)
            value *= math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
            angle = m * np.arctan2(y, x)
            columns.append(value * (math.sqrt(2.0) * (np.sin(angle) if order < 0 else np.cos(angle)) if m else 1.0))
    return np.stack(columns, axis=1)
