# SPDX-License-Identifier: Apache-2.0
"""`csplat verify`: violations by clause, and declared errors against a source.

Also: csplat_tools.cli.verify, csplat_tools.inspect.verification.
"""

import json

import numpy as np
import pytest
from command_line import invoke, printed, refused

from csplat import _spec, write_ply
from csplat.ply import read_ply
from csplat_conformance.manifest import VECTORS

pytestmark = pytest.mark.usefixtures("no_first_view")


def test_decode_and_verify_refuse_more_splats_than_allowed(tmp_path, csplat_file):
    assert "LIM-1" in invoke("verify", csplat_file, "--limit-splats", 199).stdout
    printed("verify", csplat_file, "--limit-splats", 200)
    assert "E_LIMIT" in refused("decode", csplat_file, tmp_path / "out.ply", "--limit-splats", 199)
    printed("decode", csplat_file, tmp_path / "out.ply", "--limit-splats", 200)


def test_verify_finds_damage(csplat_file):
    assert "intact" in printed("verify", csplat_file)
    assert json.loads(printed("verify", csplat_file, "--json"))["holds"]
    assert "" == printed("verify", csplat_file, "--quiet")
    data = bytearray(csplat_file.read_bytes())
    data[len(data) // 2] ^= 0x40
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--json")
    report = json.loads(result.stdout)
    assert (1, False) == (result.exit_code, report["holds"])
    assert "CHK-1" in {one["clause"] for one in report["violations"]}


def test_every_violation_is_listed_with_its_clause(ply, csplat_file):
    data = bytearray(csplat_file.read_bytes())
    data[14] = 1  # a reserved field of the header
    at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["scene_flags"]
    data[at] |= 0x08  # and a reserved flag of the scene
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--source", ply)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    clauses = [" ".join(line.split()[:2]) for line in lines]
    assert ["RES-1 E_RESERVED", "HDR-3 E_CRC", "RES-1 E_RESERVED", "IDX-1 E_CRC"] == clauses
    assert f"at byte {at}, index.scene_flags: bits 0x08 are reserved" in lines[2]
    first, second = result.stderr.splitlines()
    assert first.startswith(f"error: {csplat_file}: 4 violations of HDR-3, IDX-1, RES-1;")
    assert "error: the declared errors were not checked" == second
    assert "" == invoke("verify", csplat_file, "--quiet").stdout


def test_a_file_of_a_later_version_calls_for_an_update():
    result = invoke("verify", VECTORS / "invalid" / "version_1_1.csplat")
    assert 1 == result.exit_code
    assert "1 violation of HDR-2; update csplat, or have it written" in result.stderr


@pytest.mark.slow
def test_verify_proves_the_declared_errors_of_their_source(tmp_path, ply, csplat_file):
    index, words = ("--source-index", tmp_path / "index.npy"), ("verify", csplat_file, "--source", ply)
    assert "the declared errors hold" in printed(*words, *index)
    verified = json.loads(printed(*words, *index, "--json"))["verification"]
    assert all((verified["rms_and_counts_verified"], *(one["holds"] for one in verified["measures"].values())))
    assert "rms and counts are not proved" in printed(*words)
    model = read_ply(ply)
    fewer = model.select(slice(0, 199))
    model.means[7] += 1.0
    model.opacities[9] = 1.0 - model.opacities[9]
    for source, more, messages in (
        (model, (), ["2 splats of the file have no splat of the source"]),
        (model, index, ["error: means: max", "error: opacities: rms"]),
        (fewer, (), ["199 splats"]),
    ):
        write_ply(tmp_path / "other.ply", source)
        result = invoke("verify", csplat_file, "--source", tmp_path / "other.ply", *more)
        assert 1 == result.exit_code
        assert [] == [message for message in messages if message not in result.stderr]


def test_a_wrong_index_is_refused(tmp_path, ply, csplat_file):
    index, wrong = np.load(tmp_path / "index.npy"), tmp_path / "wrong.npy"
    assert list(range(200)) == sorted(index)
    words = ("verify", csplat_file, "--source", ply, "--source-index", wrong)
    for values, message in ((index[:-1], "200"), (index.astype(np.float64), ""), (index + 1, "")):
        np.save(wrong, values)
        assert message in refused(*words, "--quiet")
    index[0] = index[1]
    np.save(wrong, index)
    result = invoke(*words)
    assert (1, True) == (result.exit_code, "splats 0 and 1 both have the source index" in result.stderr)
    assert invoke("verify", csplat_file, "--source-index", wrong).exit_code == 2
