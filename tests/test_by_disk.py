"""Proofs of stated errors by way of the disk: what they find in parts is what is found in memory."""

import json
import multiprocessing
import os
import shutil
import signal
import tempfile
from collections import namedtuple
from dataclasses import replace
from mmap import mmap

import numpy as np
import pytest
from typer.testing import CliRunner

from csplat.decoder import decode, open_tiles
from csplat.disk_files import read_array
from csplat.encoder import EncodeOptions, encode_with_report
from csplat.errors import InputError
from csplat.ply import write_ply
from csplat.scene_source import source_from_model
from csplat.system import CAN_FORK
from csplat_conformance.declared_bounds import PartSizes, Source, check_source_index, verify_bounds, verify_out_of_core
from csplat_conformance.declared_bounds.out_of_core_verification import CellTree
from csplat_tools.cli.app import app

pytestmark = pytest.mark.slow  # two CPU seconds together

OPTIONS = EncodeOptions(preset="fast", tile_splats=300, keep_extra=True)
PARTS = PartSizes(least=200, most=200)  # small scenes have several


def both(source, data, stated=None, index=None):
    """Return the proofs made in memory and by way of the disk as JSON, with numbers rounded to nine digits."""
    opened = open_tiles(data)
    opened = replace(opened, declared_bounds=stated or opened.declared_bounds)
    at_once = verify_bounds(Source.of(source), decode(data), opened.header, opened.declared_bounds, index)
    in_parts = verify_out_of_core(source_from_model(source), opened, index, memory_bytes=1, sizes=PARTS)
    assert at_once.failures == in_parts.failures
    assert at_once.clauses == in_parts.clauses
    return rounded(at_once.as_json()), rounded(in_parts.as_json())


def rounded(value):
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return float(f"{value:.9g}") if isinstance(value, float) else value


def states(stated, **changes):
    records = tuple(replace(one, **changes.get(one.measure, {})) for one in stated.records)
    return replace(stated, records=records)


@pytest.mark.parametrize("indexed", [True, False])
def test_what_is_true_is_proved(make_model, indexed):
    source = make_model(450, 1, origin=(1e6, -2.0, 3.5), extra={"label": np.arange(450, dtype=np.int32)})
    result = encode_with_report(source, OPTIONS)
    at_once, in_parts = both(source, result.data, index=result.source_index if indexed else None)
    assert at_once == in_parts
    assert not at_once["failures"]
    assert indexed == at_once["rms_and_counts_proved"]


@pytest.mark.parametrize("indexed", [True, False])
def test_centres_in_doubles_are_those_of_the_source(make_model, indexed):
    model = make_model(500, 0)
    doubles = model.means.astype(np.float64) + np.array([5e5, 4e6, 30.0])
    source = replace(model, means_double=doubles, means=(doubles - [5e5, 4e6, 30.0]).astype(np.float32),
                     origin=(5e5, 4e6, 30.0))  # fmt: skip
    result = encode_with_report(source, OPTIONS)
    at_once, in_parts = both(source, result.data, index=result.source_index if indexed else None)
    assert at_once == in_parts
    assert not at_once["failures"]


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("attribute", ["means", "sh0", "extra"])
def test_what_is_false_is_told_in_the_same_words(make_model, indexed, attribute):
    source = make_model(450, 1, extra={"label": np.arange(450, dtype=np.int32)})
    result = encode_with_report(source, OPTIONS)
    if attribute == "extra":
        changed = replace(source, extra={"label": source.extra["label"] // 2})
    else:
        array = getattr(source, attribute).copy()
        array[[3, 200, 449]] += np.float32(0.7)
        changed = replace(source, **{attribute: array})
    at_once, in_parts = both(changed, result.data, index=result.source_index if indexed else None)
    assert at_once == in_parts
    assert bool(at_once["failures"]) == (indexed or attribute != "extra")


def test_a_partner_beyond_the_lattice_is_looked_for_as_far_as_is_stated(make_model):
    source = make_model(500, 0)
    result = encode_with_report(source, OPTIONS)
    moved = replace(source, means=source.means + np.float32(0.04))
    stated = open_tiles(result.data).declared_bounds
    for most in (0.2, 0.06):
        at_once, in_parts = both(moved, result.data, states(stated, means={"max": most}))
        assert at_once == in_parts
        assert bool(at_once["failures"]) == (most < 0.07)


@pytest.mark.skipif(not CAN_FORK, reason="processes are no copies of each other here")
def test_processes_find_what_one_finds(make_model, monkeypatch):
    source = make_model(600, 1)
    opened = open_tiles(encode_with_report(source, OPTIONS).data)
    far = np.where(np.arange(600) % 50, np.float32(0.04), np.float32(0.5))
    moved = replace(source, means=source.means + far[:, None])
    opened = replace(opened, declared_bounds=states(opened.declared_bounds, means={"max": 0.07}))
    alone = verify_out_of_core(source_from_model(moved), opened, memory_bytes=1, sizes=PARTS)
    assert alone.failures
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    memory, sizes, seen = 10**9, replace(PARTS, worth_a_process=1), []

    def count(_stage, _done):
        seen.append(len(multiprocessing.active_children()))

    def kill(_stage, _done):
        for child in multiprocessing.active_children():
            os.kill(child.pid, signal.SIGKILL)

    assert alone == verify_out_of_core(
        source_from_model(moved), opened, memory_bytes=memory, sizes=sizes, progress=count
    )
    assert max(seen) == 3
    with pytest.raises(OSError, match="a worker process was killed"):
        verify_out_of_core(source_from_model(moved), opened, memory_bytes=memory, sizes=sizes, progress=kill)


def test_another_scene_is_told_before_any_splat(make_model):
    result = encode_with_report(make_model(400, 1), OPTIONS)
    at_once, in_parts = both(make_model(401, 0), result.data)
    assert at_once == in_parts
    assert len(at_once["failures"]) == 2


@pytest.mark.parametrize("indexed", [True, False])
def test_a_scene_of_no_splats_is_proved(make_model, indexed):
    source = make_model(0, 1)
    result = encode_with_report(source, OPTIONS)
    at_once, in_parts = both(source, result.data, index=result.source_index if indexed else None)
    assert at_once == in_parts


def test_splats_of_one_place_are_no_part_that_is_too_large(make_model):
    source = make_model(900, 0, means=np.full((900, 3), 0.5, np.float32))
    result = encode_with_report(source, OPTIONS)
    at_once, in_parts = both(source, result.data)
    assert at_once == in_parts
    assert not at_once["failures"]


def test_cells_have_about_as_many_splats(make_model):
    source = make_model(4000, 0)
    opened = open_tiles(encode_with_report(source, OPTIONS).data)
    places = CellTree.of(opened.header, 4000, 500).place(source.means)
    counts = np.bincount(places)
    assert len(counts) == 8
    assert counts.min() > 100
    assert counts.max() < 1200


@pytest.mark.parametrize(
    ("index", "words"),
    [
        (np.array([0, 1, 1]), "splats 1 and 2 both splat 1"),
        (np.array([2, 0, 2]), "splats 0 and 2 both splat 2"),
        (np.array([0, 1, 5]), "splat 2 splat 5"),
    ],
)
def test_a_source_index_is_looked_at_in_parts(index, words):
    for block in (1, 2, 3):
        with pytest.raises(InputError, match=words):
            check_source_index(index, 5, 3, block=block)


def test_the_disk_is_asked_before_and_nothing_stays_there(make_model, tmp_path, monkeypatch):
    source = make_model(450, 1)
    result = encode_with_report(source, OPTIONS)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    both(source, result.data)
    assert [] == list(tmp_path.iterdir())
    monkeypatch.setattr(shutil, "disk_usage", lambda _: namedtuple("usage", "free")(1000))  # noqa: PYI024  # a stand-in
    with pytest.raises(InputError, match=r"0 MB free, and 0 are wanted .*TMPDIR"):
        both(source, result.data)


def test_a_source_index_may_be_mapped(make_model, tmp_path):
    source = make_model(500, 1)
    result = encode_with_report(source, OPTIONS)
    np.save(tmp_path / "index.npy", result.source_index)
    mapped = read_array(str(tmp_path / "index.npy"), most_bytes=0)
    assert isinstance(mapped.base, mmap)
    assert both(source, result.data, index=result.source_index) == both(source, result.data, index=mapped)


def test_the_command_finds_by_way_of_the_disk_what_it_finds_in_memory(make_model, tmp_path):
    ply, file, index = tmp_path / "scene.ply", tmp_path / "scene.csplat", tmp_path / "index.npy"
    source = make_model(700, 1)
    result = encode_with_report(source, OPTIONS)
    write_ply(ply, source)
    file.write_bytes(result.data)
    np.save(index, result.source_index)
    for words in ([], ["--source-index", str(index)]):
        found = []
        for memory in ([], ["--memory", "100kB"]):
            said = CliRunner().invoke(
                app, ["verify", str(file), "--source", str(ply), "--json", "--quiet", *words, *memory]
            )
            assert said.exit_code == 0, said.output
            found.append(rounded(json.loads(said.stdout)))
        assert found[0] == found[1]
