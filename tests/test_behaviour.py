"""The behaviour snapshot (behaviour.py): what is encoded, trained, tuned and reported stays as it is."""

import behaviour
import pytest

pytest.importorskip("numba", reason="renders require the extra [render]")


def check(group, record_property):
    lines, loosely = behaviour.changes(group)
    if loosely:
        record_property("compared loosely", loosely)
    words = f"{len(lines)} changes. If they are meant: python tests/behaviour.py renew {group}"
    assert [] == lines, "\n".join([words, *lines])


def test_files_of_every_preset_are_the_recorded_ones(record_property):
    check("encode", record_property)


@pytest.mark.slow
def test_a_training_a_tuning_and_two_targets_give_the_recorded_files(record_property):
    check("fit", record_property)


@pytest.mark.slow
def test_every_command_reports_what_is_recorded(record_property):
    check("report", record_property)


@pytest.mark.long
def test_files_of_shared_scenes_are_the_recorded_ones(data_dir, record_property):  # noqa: ARG001  # skips if absent
    check("shared", record_property)


def test_each_kind_of_difference_is_named():
    golden = {"a": {"parts": {"TILE": "12"}, "size_bytes": 100, "psnr": 30.0}, "gone": 1, "same": [1, True, "x"]}
    found = {"a": {"parts": {"TILE": "13"}, "size_bytes": 101, "psnr": 30.004}, "new": 1, "same": [1, True, "x"]}
    lines = ["/a/parts/TILE: '12' became '13'", "/a/size_bytes: 100 became 101", "/gone: is gone", "/new: is new"]
    assert lines == behaviour.differences(golden, found)
    assert ["/0: True became 1"] == behaviour.differences([True], [1])


def test_another_environment_is_compared_by_size_and_psnr():
    golden = {"parts": {"TILE": "12"}, "size_bytes": 100, "psnr": 30.0, "steps": 20}
    near = {"parts": {"TILE": "13"}, "size_bytes": 101, "psnr": 30.09, "steps": 21}
    far = {"parts": {"TILE": "13"}, "size_bytes": 103, "psnr": 30.11, "steps": 22}
    assert [] == behaviour.differences(golden, near, loosely=True)
    assert ["/psnr", "/size_bytes", "/steps"] == [
        line.partition(":")[0] for line in behaviour.differences(golden, far, loosely=True)
    ]


def test_times_paths_and_versions_are_left_out(tmp_path):
    report = {"seconds": 2, "file": f"{tmp_path}/x.ply", "by": "csplat 0.1.0, numpy 2.4.6", "kept": 1.00000000001}
    assert {"file": "…/x.ply", "by": "csplat, numpy", "kept": 1.0} == behaviour.plain(report, tmp_path)
