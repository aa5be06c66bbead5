import zipfile

import numpy as np
import pytest

from csplat.archives import read_archive
from csplat.errors import InputError

KIND = "a file of tests"
BROKEN = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': ("


def archive(path, data, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("facts.npy", data)
    return path


def test_arrays_come_back(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.arange(3), facts=np.frombuffer(b'{"n": 1}', np.uint8))
    found = read_archive(tmp_path / "a.npz", KIND)
    assert np.array_equal(np.arange(3), found["one"])
    assert found.facts() == {"n": 1}
    found.check({"n": 1}, {"n": int})


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"hello", "facts is no array"),
        (BROKEN.ljust(128, b" "), "not a file of tests"),
        (b"\x93NUMPY\x09\x09", "not a file of tests"),
        (b"", "not a file of tests"),
    ],
    ids=["bytes", "open bracket", "version", "empty"],
)
def test_members_that_are_no_arrays_are_refused(tmp_path, data, why):
    with pytest.raises(InputError, match=why):
        read_archive(archive(tmp_path / "a.npz", data), KIND)


def test_objects_are_not_run(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="not a file of tests"):
        read_archive(tmp_path / "a.npz", KIND)


@pytest.mark.parametrize("way", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_is_named_however_the_file_is_packed(tmp_path, way):
    np.save(tmp_path / "a.npy", np.random.default_rng(1).normal(size=400))
    path = archive(tmp_path / "a.npz", (tmp_path / "a.npy").read_bytes(), way)
    data = path.read_bytes()
    for place in range(60, 1000, 37):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        with pytest.raises(InputError, match=r"a\.npz is not a file of tests"):
            read_archive(path, KIND)


@pytest.mark.parametrize("text", [b"[1]", b"{", b"[" * 100_000, b"\xff"], ids=["list", "open", "deep", "no text"])
def test_facts_that_are_none_are_refused(tmp_path, text):
    np.savez(tmp_path / "a.npz", facts=np.frombuffer(text, np.uint8))
    with pytest.raises(InputError, match="not a file of tests"):
        read_archive(tmp_path / "a.npz", KIND).facts()


def test_what_is_missing_or_of_another_kind_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.zeros(1))
    found = read_archive(tmp_path / "a.npz", KIND)
    with pytest.raises(InputError, match="holds no two"):
        found["two"]
    with pytest.raises(InputError, match="its n is no int"):
        found.check({"n": "1"}, {"n": int})


def test_a_file_that_is_not_there_is_missed(tmp_path):
    with pytest.raises(FileNotFoundError, match="absent"):
        read_archive(tmp_path / "absent.npz", KIND)
