# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.data.colmap."""

import numpy as np
import pytest
from posed_sets import cameras, write_colmap

from csplat.errors import InputError
from csplat_trainer.data.colmap import read_images, read_points


@pytest.mark.slow
def test_every_prefix_of_colmap_files_and_names_with_control_characters_are_refused(tmp_path):
    write_colmap(tmp_path, cameras(2))
    for name, read in (("images.bin", read_images), ("points3D.bin", read_points)):
        file, data = tmp_path / name, (tmp_path / name).read_bytes()
        for end in range(len(data)):
            file.write_bytes(data[:end])
            with pytest.raises(InputError):
                read(file)
        for content, message in ((data + b"\0", "follow"), (b"\xff" * 8 + data[8:], "ends at byte")):
            file.write_bytes(content)
            with pytest.raises(InputError, match=message):
                read(file)
    write_colmap(tmp_path, cameras(2))
    file = tmp_path / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"im 001", b"im\n001"))
    with pytest.raises(InputError, match=r"the name at byte .* has control characters"):
        read_images(file)


def test_points_with_non_finite_values_are_left_out(tmp_path):
    rows = ("1 0 0 1 255 0 51", "2 0 nan 0 1 2 3", "3 0 0 1e300 1 2 3", "4 0 0 1 1 inf 3", "5 0 1 0 0 0 0")
    (tmp_path / "points3D.txt").write_text("\n".join(rows))
    points, colours = read_points(tmp_path / "points3D.txt")
    assert [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]] == points.tolist()
    np.testing.assert_allclose([[1.0, 0.0, 0.2], [0.0, 0.0, 0.0]], colours)
    (tmp_path / "points3D.txt").write_text("")
    assert 0 == len(read_points(tmp_path / "points3D.txt")[0])
    (tmp_path / "points3D.txt").write_bytes(b"\xff")
    with pytest.raises(InputError, match="byte 0 is 0xff, which is not UTF-8"):
        read_points(tmp_path / "points3D.txt")
