import json

import numpy as np
import pytest
from cli_cases import call, invoke, refused

from csplat import _spec, read_ply, write_ply

pytestmark = pytest.mark.usefixtures("no_estimated_up")


def test_decode_and_verify_refuse_more_splats_than_allowed(tmp_path, csplat_file):
    assert "LIM-1" in invoke("verify", csplat_file, "--max-splats", 199).stdout
    call("verify", csplat_file, "--max-splats", 200)
    assert "E_LIMIT" in refused("decode", csplat_file, tmp_path / "out.ply", "--max-splats", 199)
    call("decode", csplat_file, tmp_path / "out.ply", "--max-splats", 200)


def test_verify_finds_damage(csplat_file):
    assert "intact" in call("verify", csplat_file)
    assert json.loads(call("verify", csplat_file, "--json"))["holds"]
    assert call("verify", csplat_file, "--quiet") == ""
    data = bytearray(csplat_file.read_bytes())
    data[len(data) // 2] ^= 0x40
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--json")
    report = json.loads(result.stdout)
    assert (1, False) == (result.exit_code, report["holds"])
    assert "CHK-1" in {one["clause"] for one in report["violations"]}


def test_every_violation_is_listed_with_its_clause(ply, csplat_file):
    data = bytearray(csplat_file.read_bytes())
    data[13] = 1  # a reserved field of the header
    at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["scene_flags"]
    data[at] |= 0x08  # and a reserved flag of the scene
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--source", ply)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert ["RES-1 E_RESERVED", "HDR-3 E_CRC", "RES-1 E_RESERVED", "IDX-1 E_CRC"] == [
        " ".join(line.split()[:2]) for line in lines
    ]
    assert f"at byte {at}, index.scene_flags: bits 0x08 are reserved" in lines[2]
    assert result.stderr.splitlines() == [
        f"error: {csplat_file}: 4 violations of HDR-3, IDX-1, RES-1; copy or make it again (E_CRC, E_RESERVED)",
        "error: the declared errors were not checked",
    ]
    assert invoke("verify", csplat_file, "--quiet").stdout == ""


@pytest.mark.slow
def test_verify_proves_the_declared_errors_of_their_source(tmp_path, ply, csplat_file):
    index = ("--source-index", tmp_path / "index.npy")
    assert "the declared errors hold" in call("verify", csplat_file, "--source", ply, *index)
    report = json.loads(call("verify", csplat_file, "--source", ply, *index, "--json"))
    assert report["proof"]["rms_and_counts_proved"]
    assert all(one["holds"] for one in report["proof"]["measures"].values())
    assert "rms and counts are not proved" in call("verify", csplat_file, "--source", ply)
    model, other = read_ply(ply), tmp_path / "other.ply"
    model.means[7] += 1.0
    model.opacities[9] = 1.0 - model.opacities[9]
    write_ply(other, model)
    results = [invoke("verify", csplat_file, "--source", other, *words) for words in ((), index)]
    write_ply(other, read_ply(ply).select(slice(0, 199)))
    results.append(invoke("verify", csplat_file, "--source", other))
    assert [1, 1, 1] == [result.exit_code for result in results]
    assert "2 splats of the file have no splat of the source" in results[0].stderr
    assert "error: means: max" in results[1].stderr
    assert "error: opacities: rms" in results[1].stderr
    assert "199 splats" in results[2].stderr


def test_a_wrong_index_is_refused(tmp_path, ply, csplat_file):
    index, wrong = np.load(tmp_path / "index.npy"), tmp_path / "wrong.npy"
    assert sorted(index) == list(range(200))
    words = ("verify", csplat_file, "--source", ply, "--source-index", wrong)
    for values, message in ((index[:-1], "200"), (index.astype(np.float64), ""), (index + 1, "")):
        np.save(wrong, values)
        assert message in refused(*words, "--quiet")
    index[0] = index[1]
    np.save(wrong, index)
    result = invoke(*words)
    assert result.exit_code == 1
    assert "splats 0 and 1 both have the source index" in result.stderr
    assert invoke("verify", csplat_file, "--source-index", wrong).exit_code == 2
