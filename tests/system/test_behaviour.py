# SPDX-License-Identifier: Apache-2.0
"""The behaviour snapshot (helpers/behaviour.py): bytes of files and keys of reports stay as they are."""

import behaviour
import pytest


def check(group):
    known, made = behaviour.recorded(), behaviour.make(group)
    lines = [
        f"{name}: {known[group].get(name)} became {one}" for name, one in made.items() if one != known[group].get(name)
    ]
    lines += [f"{name} is gone" for name in known[group].keys() - made.keys() if group != "shared"]
    words = f"{len(lines)} changes. If they are meant: python tests/helpers/behaviour.py renew {group}"
    assert not lines, "\n".join([words, *lines])


def check_bytes(group):
    known = behaviour.recorded()["libdeflate"]
    if behaviour.libdeflate() != known:
        pytest.skip(f"deflate {behaviour.libdeflate()} compresses otherwise than {known}, of the snapshot")
    check(group)


@pytest.mark.slow
def test_files_of_every_preset_have_the_recorded_bytes():
    check_bytes("bytes")


@pytest.mark.long
def test_files_of_shared_scenes_have_the_recorded_bytes(data_dir):  # noqa: ARG001  # skips if absent
    check_bytes("shared")


@pytest.mark.slow
def test_reports_of_every_command_have_the_recorded_keys():
    check("keys")
