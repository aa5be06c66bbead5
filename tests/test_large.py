"""Out-of-core encoding: the same bytes as in memory, resumed runs, full disks, lost workers."""

import errno
import json
import multiprocessing
import os
import resource
import shutil
import signal
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from csplat import EncodeOptions, InputError, decode, encode, encode_with_report, read_ply, write_ply
from csplat import open as csplat_open
from csplat.encoder import LevelNode, buckets, encode_plan, encode_tiles
from csplat.encoder.buckets import BucketCurve, bucket_rows
from csplat.formats import open_scene
from csplat.out_of_core import OutOfCoreOptions, encode_scene, estimate_cost
from csplat.scene_source import join_blocks, source_from_model
from csplat_conformance.validator import validate
from csplat_tools.cli.app import app
from csplat_tools.encode_file import encode_file, may_exceed_memory

WHOLE = 600  # splats per bucket
COUNT = 6 * WHOLE
FAST = EncodeOptions(
    preset="fast", threads=1, sh_degree=1, sh_coding="codebook", codebook_size=32, bucket_splats=WHOLE
)  # fmt: skip


def encode_large(scene, target, options, *, progress=None, levels=None, **limits):
    return encode_scene(
        scene, target, options, OutOfCoreOptions(always=True, **limits), levels=levels, progress=progress
    )


@dataclass(frozen=True)
class EveryFourth:
    """Levels of every fourth splat: a node for each bucket, and one above all of them; errors are the levels."""

    whole_splats: int = WHOLE

    def settings(self, count):
        return {"splats": f"every fourth of {count}"}

    def seconds(self, count):
        return 1e-5 * count

    def build_part(self, splats, scene_count, threads):
        assert (COUNT, 1) == (scene_count, threads)
        coarse = replace(splats.select(np.arange(0, len(splats), 4)), extra={}, means_double=None)
        return [LevelNode(0, 1, rows=np.arange(len(splats))), LevelNode(1, None, splats=coarse)]

    def build_top(self, roots, threads, progress):
        assert threads in (1, 2)
        parts = list(roots)
        progress("building levels", 1.0)
        scene = join_blocks(parts[0], parts)
        return [0] * len(parts), [LevelNode(2, None, splats=scene.select(np.arange(0, len(scene), 4)))]

    def measure(self, encoded, threads, progress):  # noqa: ARG002 - of the protocol
        nodes = [replace(node, error=float(node.level), squares=(0.5,)) for node in encoded.nodes]
        return replace(encoded, nodes=nodes)

    def encode(self, model, options, progress):
        raise NotImplementedError


@pytest.fixture(scope="module")
def model(sample_path):
    sample, rng = read_ply(sample_path), np.random.default_rng(5)
    many = sample.select(rng.integers(0, len(sample), COUNT))
    means = many.means + rng.normal(0, 0.05, many.means.shape).astype(np.float32)
    extra = {"confidence": np.arange(COUNT, dtype=np.uint16)}
    return replace(many, means=means, extra=extra, metadata={"licence": "CC0"})


@pytest.fixture(scope="module")
def whole(model):
    """The file of the scene, encoded in memory."""
    return encode(model, FAST)


def test_out_of_core_encoding_gives_the_bytes_of_memory(model, whole, tmp_path):
    stages = {}
    note = lambda stage, done: stages.update({stage: done})  # noqa: E731
    report = encode_large(source_from_model(model), tmp_path / "out.csplat", FAST, progress=note)
    assert whole == (tmp_path / "out.csplat").read_bytes()
    assert ["out.csplat"] == [path.name for path in tmp_path.iterdir()]
    assert (len(model), len(whole)) == (report.splat_count, report.size_bytes)
    assert {"looking", "sorting", "codebook", "coding", "writing"} == set(stages)
    assert 1.0 == stages["looking"] == stages["sorting"] == stages["coding"]


def test_a_file_of_many_buckets_is_valid_with_declared_errors(model, whole):
    assert validate(whole).conforms
    result = encode_with_report(model, FAST)
    assert COUNT == len(np.unique(result.source_index))
    decoded = decode(result.data)
    distance = np.linalg.norm(decoded.means - model.means[result.source_index], axis=1)
    assert distance.max() <= result.report.errors["means"][0]
    assert 7 <= result.report.tile_count <= 12


def test_the_sample_of_a_plan_has_refitted_colours(model):
    other = encode_plan.EncodePlan.of(model, FAST).with_colours(model.sh0 + 0.5, -model.shN)
    assert other.sample is not None
    assert np.array_equal(-model.shN[buckets.sample_rows(COUNT, WHOLE)], other.sample.model.shN)
    decoded = decode(encode_tiles(other).write().data)
    assert abs(decoded.sh0.mean() - model.sh0.mean() - 0.5) < 0.01


@pytest.fixture(scope="module")
def with_levels(model, tmp_path_factory):
    """The file of the scene with levels of detail."""
    path = tmp_path_factory.mktemp("levels") / "out.csplat"
    encode_large(source_from_model(model), path, FAST, levels=EveryFourth())
    return path.read_bytes()


def test_each_bucket_is_a_subtree_of_the_levels(whole, with_levels):
    assert validate(with_levels).conforms
    with csplat_open(with_levels) as file:
        counts = [sum(node.splat_count for node in file.nodes if node.level == level) for level in range(3)]
        assert COUNT == counts[0]
        assert COUNT / 4 <= counts[1] < COUNT / 4 + len(file.nodes)
        assert 1 == sum(node.parent is None for node in file.nodes)
        assert {0.0, 1.0, 2.0} == {node.error for node in file.nodes}
    for name in ("means", "opacities", "sh0"):  # level 0 has the same steps
        assert np.array_equal(getattr(decode(whole), name), getattr(decode(with_levels), name))


@pytest.mark.parametrize("memory", [None, 900_000_000])
def test_levels_do_not_depend_on_processes_or_memory(model, with_levels, tmp_path, memory):
    target = tmp_path / "out.csplat"
    encode_large(source_from_model(model), target, replace(FAST, threads=2), levels=EveryFourth(), memory_bytes=memory)
    assert with_levels == target.read_bytes()


@pytest.mark.parametrize(("stage", "after"), [("sorting", 0), ("coding", 3), ("writing", 0)])
def test_an_interrupted_encoding_with_levels_is_resumed(model, with_levels, tmp_path, stage, after):
    target, scene = tmp_path / "out.csplat", source_from_model(model)
    with pytest.raises(KeyboardInterrupt):
        encode_large(scene, target, FAST, levels=EveryFourth(), progress=Interrupt(stage, after=after))
    assert not target.exists()
    with pytest.raises(InputError, match="was started with levels"):
        encode_large(scene, target, FAST, resume=True)
    encode_large(scene, target, FAST, levels=EveryFourth(), resume=True)
    assert with_levels == target.read_bytes()
    assert [target] == list(tmp_path.iterdir())


def test_a_disk_that_fills_up_while_levels_are_written_is_reported(model, with_levels, tmp_path):
    target, before = tmp_path / "out.csplat", resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, _done):
        if stage == "coding":
            resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, before[1]))

    try:
        with pytest.raises(OSError, match="File too large"):
            encode_large(source_from_model(model), target, FAST, levels=EveryFourth(), progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not target.exists()
    assert not list((tmp_path / "out.csplat.work").glob("*.part*"))
    encode_large(source_from_model(model), target, FAST, levels=EveryFourth(), resume=True)
    assert with_levels == target.read_bytes()


def test_a_scene_built_in_one_piece_requires_its_memory(model, tmp_path):
    with pytest.raises(InputError, match="300 MB of memory are too little for this scene, which requires 3"):
        encode_large(
            source_from_model(model), tmp_path / "out.csplat", FAST, levels=EveryFourth(COUNT), memory_bytes=300_000_000
        )


def test_two_processes_give_the_same_bytes(model, whole, tmp_path):
    encode_large(source_from_model(model), tmp_path / "out.csplat", replace(FAST, threads=2))
    assert whole == (tmp_path / "out.csplat").read_bytes()


@pytest.mark.parametrize(
    "options",
    [
        EncodeOptions(preset="fast", sh_coding="scalar", keep_extra=True, bucket_splats=WHOLE),
        EncodeOptions(preset="small", sh_degree=0, bucket_splats=WHOLE),
        EncodeOptions(preset="fast", sh_degree=1, adaptive=0.5, tile_splats=300, bucket_splats=WHOLE),
    ],
)
def test_options_give_the_bytes_of_memory(model, options, tmp_path):
    encode_large(source_from_model(model), tmp_path / "out.csplat", options)
    assert encode(model, options) == (tmp_path / "out.csplat").read_bytes()


def test_doubles_and_huge_values_give_the_bytes_of_memory(model, tmp_path):
    origin = (4.5e5, 5.4e6, 100.0)
    doubles = model.means.astype(np.float64) + np.array(origin) + 1e-9
    scales, shN = model.scales.copy(), model.shN.copy()
    scales[17], scales[1600], shN[3200] = 95.0, 1e5, 3e8
    means = (doubles - np.array(origin)).astype(np.float32)
    hard = replace(model, means=means, origin=origin, means_double=doubles, scales=scales, shN=shN)
    options = EncodeOptions(preset="fast", sh_degree=1, threads=1, bucket_splats=WHOLE)
    encode_large(source_from_model(hard), tmp_path / "out.csplat", options)
    assert encode(hard, options) == (tmp_path / "out.csplat").read_bytes()


class Interrupt:
    """Progress that raises an error in a stage."""

    def __init__(self, stage, error=KeyboardInterrupt, after=0):
        self.stage, self.error, self.after = stage, error, after

    def __call__(self, stage, _done):
        if stage == self.stage:
            self.after -= 1
            if self.after < 0:
                raise self.error


@pytest.mark.parametrize(("stage", "after"), [("looking", 0), ("sorting", 0), ("codebook", 0), ("coding", 3)])
def test_an_interrupted_encoding_is_resumed(model, whole, tmp_path, stage, after):
    target, scene = tmp_path / "out.csplat", source_from_model(model)
    with pytest.raises(KeyboardInterrupt):
        encode_large(scene, target, FAST, progress=Interrupt(stage, after=after))
    assert not target.exists()
    assert (tmp_path / "out.csplat.work").is_dir()
    with pytest.raises(InputError, match="left from an interrupted encoding"):
        encode_large(scene, target, FAST)
    with pytest.raises(
        InputError, match=r"started with options .*: continue with the former options, or remove the folder"
    ):
        encode_large(scene, target, replace(FAST, seed=1), resume=True)
    coded = []
    encode_large(scene, target, FAST, resume=True, progress=lambda stage, _done: coded.append(stage))
    assert whole == target.read_bytes()
    if stage == "coding":
        assert "sorting" not in coded
    assert [target] == list(tmp_path.iterdir())


def test_an_encoding_with_a_killed_worker_is_resumed(model, whole, tmp_path):
    target, two = tmp_path / "out.csplat", replace(FAST, threads=2)

    def kill(stage, _done):
        if stage == "coding":
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)

    with pytest.raises(OSError, match="a worker process was killed") as error:
        encode_large(source_from_model(model), target, two, progress=kill)
    assert errno.ENOMEM == error.value.errno
    assert not target.exists()
    encode_large(source_from_model(model), target, two, resume=True)
    assert whole == target.read_bytes()


def test_a_full_disk_is_reported_and_the_encoding_resumed(model, whole, tmp_path, monkeypatch):
    target = tmp_path / "out.csplat"
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=1000))
        with pytest.raises(InputError, match="0 MB free, 1 MB are needed"):
            encode_large(source_from_model(model), target, FAST)
    assert not list(tmp_path.iterdir())
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, _done):
        if stage == "sorting":  # a part of each bucket can be written
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))

    try:
        with pytest.raises(OSError, match="File too large"):
            encode_large(source_from_model(model), target, FAST, progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not target.exists()
    assert [10_000] == [path.stat().st_size for path in (tmp_path / "out.csplat.work").glob("section-*")]
    encode_large(source_from_model(model), target, FAST, resume=True)
    assert whole == target.read_bytes()


@pytest.mark.parametrize("kind", ["sample", "section-000003", "tiles-000001", "state.json"])
def test_a_damaged_work_file_is_named(model, tmp_path, kind):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(source_from_model(model), target, FAST, progress=Interrupt("coding", after=2))
    path = tmp_path / "out.csplat.work" / kind
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if kind != "state.json" else 0] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"{kind} is damaged: remove out.csplat.work"):
        encode_large(source_from_model(model), target, FAST, resume=True)
    assert not target.exists()


def test_a_folder_with_other_fields_of_state_is_refused(model, tmp_path):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(source_from_model(model), target, FAST, progress=Interrupt("coding"))
    path = tmp_path / "out.csplat.work" / "state.json"
    path.write_text(path.read_text().replace("largest_sh", "largest"))
    with pytest.raises(InputError, match=r"state\.json is damaged: remove out.csplat.work"):
        encode_large(source_from_model(model), target, FAST, resume=True)


def test_a_folder_with_other_files_is_refused_and_kept(model, tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "one.jpg").write_bytes(b"dear to somebody")
    for resume in (False, True):
        with pytest.raises(InputError, match="photographs is not empty"):
            encode_large(source_from_model(model), tmp_path / "out.csplat", FAST, folder=folder, resume=resume)
    assert b"dear to somebody" == (folder / "one.jpg").read_bytes()


def test_an_out_of_core_encoding_is_resumed_with_more_memory(model, whole, tmp_path):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(source_from_model(model), target, FAST, progress=Interrupt("coding", after=2))
    stages = []
    resume = OutOfCoreOptions(resume=True)
    encode_scene(source_from_model(model), target, FAST, resume, progress=lambda stage, _done: stages.append(stage))
    assert "coding" in stages
    assert "sorting" not in stages
    assert whole == target.read_bytes()
    assert [target] == list(tmp_path.iterdir())


def test_a_scene_that_shrinks_while_it_is_read_is_refused(model, tmp_path):
    times = []

    def blocks():
        times.append(1)
        yield model.select(slice(0, COUNT if len(times) == 1 else 3000))

    with pytest.raises(InputError, match="the scene has 3,000 splats, expected 3,600"):
        encode_large(replace(source_from_model(model), blocks=blocks), tmp_path / "out.csplat", FAST)
    assert not (tmp_path / "out.csplat").exists()


def test_too_little_memory_is_refused(model, tmp_path):
    with pytest.raises(InputError, match="100 MB of memory are too little for this scene, which requires 2"):
        encode_large(source_from_model(model), tmp_path / "out.csplat", FAST, memory_bytes=100_000_000)
    with pytest.raises(InputError, match="a codebook of shapes requires the scene in memory"):
        encode_large(source_from_model(model), tmp_path / "out.csplat", replace(FAST, shape_codebook_size=64))
    assert not list(tmp_path.iterdir())


def test_buckets_partition_the_splats_by_place(model):
    rows = bucket_rows(model.means, WHOLE)
    assert np.array_equal(np.arange(len(model)), np.sort(np.concatenate(rows)))
    assert max(map(len, rows)) <= WHOLE
    assert all((np.diff(part) > 0).all() for part in rows)
    volume = np.ptp(model.means, axis=0).prod()
    assert np.median([np.ptp(model.means[part], axis=0).prod() for part in rows]) < volume / 4


def test_a_large_bucket_is_split_into_equal_parts():
    rng = np.random.default_rng(1)
    means = rng.normal(0, 1, (COUNT, 3)).astype(np.float32)
    means[buckets.sample_rows(COUNT, WHOLE)] += 100.0  # the sampled rows are far from the others
    parts = bucket_rows(means, WHOLE)
    assert np.array_equal(np.arange(COUNT), np.sort(np.concatenate(parts)))
    assert max(map(len, parts)) <= WHOLE
    same = bucket_rows(np.ones((1600, 3), np.float32), WHOLE)
    assert [533, 533, 534] == [len(part) for part in same]
    assert [0, 533, 1066, 1600] == [part[0] for part in same] + [1600]
    assert all(first[-1] < second[0] for first, second in pairwise(same))


def test_a_small_scene_has_one_bucket():
    assert 1 == BucketCurve.through(np.zeros((10, 3), np.float32), WHOLE, WHOLE).count


@pytest.mark.slow
@pytest.mark.remote
def test_a_cluster_with_a_killed_worker_gives_the_same_bytes(model, whole, with_levels, tmp_path):
    distributed = pytest.importorskip("distributed", reason="a cluster requires the extra [scale]")
    target = tmp_path / "out.csplat"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        victims = [one.pid for one in cluster.workers.values()]

        def kill(stage, _done):
            if stage == "coding" and victims:
                os.kill(victims.pop(), signal.SIGKILL)
                victims.clear()

        encode_large(source_from_model(model), target, FAST, scheduler=cluster.scheduler_address, progress=kill)
        assert not victims
        assert whole == target.read_bytes()
        encode_large(source_from_model(model), target, FAST, scheduler=cluster.scheduler_address, levels=EveryFourth())
    assert with_levels == target.read_bytes()


@pytest.mark.remote
def test_an_unreachable_cluster_is_reported(model, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="a cluster requires the extra [scale]")
    monkeypatch.setattr(distributed, "Client", partial_client(distributed.Client))
    with pytest.raises(OSError, match=r"127\.0\.0\.1:9"):
        encode_large(source_from_model(model), tmp_path / "out.csplat", FAST, scheduler="tcp://127.0.0.1:9")


def partial_client(client):
    return lambda address, **options: client(address, **{**options, "timeout": 0.2})


@pytest.fixture
def ply(model, tmp_path):
    write_ply(tmp_path / "scene.ply", replace(model, extra={}, metadata={}))
    return tmp_path / "scene.ply"


def test_a_file_is_encoded_out_of_core_on_request(ply, tmp_path):
    target, limits = tmp_path / "out.csplat", OutOfCoreOptions(memory_bytes=300_000_000, always=True)
    options = EncodeOptions(preset="fast", sh_degree=1, threads=1, bucket_splats=WHOLE)
    with open_scene(ply) as scene:
        cost = estimate_cost(scene, options, limits)
    assert (COUNT, 1, False) == (cost.splats, cost.sh_degree, cost.in_memory)
    assert 0 < cost.memory_bytes <= 300e6
    stages = []
    note = lambda stage, _done: stages.append(stage)  # noqa: E731
    encoded = encode_file(str(ply), str(target), options, out_of_core=limits, progress=note)
    assert {"sorting", "coding"} <= set(stages)
    assert encoded.report.size_bytes == target.stat().st_size
    with open_scene(ply) as scene:
        assert encode(scene.model(), options) == target.read_bytes()


def test_the_command_passes_out_of_core_options(ply, tmp_path, monkeypatch):
    target, limits = tmp_path / "out.csplat", []

    def encode_here(scene, target, options, asked, **others):
        limits.append(asked)
        return encode_scene(scene, target, options, asked, **others)

    monkeypatch.setattr("csplat_tools.encode_file.encode_scene", encode_here)
    run = CliRunner().invoke
    dry = run(app, ["encode", str(ply), str(target), "--memory", "300MB", "--dry-run", "--json"])
    assert 0 == dry.exit_code
    cost = json.loads(dry.stdout)
    assert (COUNT, 3, True) == (cost["splats"], cost["sh_degree"], cost["in_memory"])
    assert not target.exists()
    words = ["--memory", "300MB", "--resume", "--preset", "fast", "--quiet"]
    done = run(app, ["encode", str(ply), str(target), *words])
    assert 0 == done.exit_code, done.output
    assert [OutOfCoreOptions(memory_bytes=300_000_000, resume=True)] == limits
    refused = run(app, ["encode", str(ply), str(target), "--resume", "--target-psnr", "40", "--force"])
    assert 2 == refused.exit_code


def test_a_large_scene_needs_little_memory_unless_levels_are_requested(model, tmp_path):
    """The splats of this file are a hole in it; an estimate does not read them."""
    ply = tmp_path / "large.ply"
    write_ply(ply, replace(model.select(slice(1)), extra={}, metadata={}))
    header, _, splat = ply.read_bytes().partition(b"end_header\n")
    header = header.replace(b"element vertex 1\n", b"element vertex 3000000\n") + b"end_header\n"
    ply.write_bytes(header)
    os.truncate(ply, len(header) + 3_000_000 * len(splat))
    words = ["encode", str(ply), "--dry-run", "--json", "--memory"]
    small, large = (CliRunner().invoke(app, [*words, size]) for size in ("500MB", "8GB"))
    assert (0, 0) == (small.exit_code, large.exit_code), small.output
    assert 400_000_000 < json.loads(small.stdout)["memory_bytes"] <= 500_000_000
    assert "" == small.stderr  # the levels do not fit
    with_levels = CliRunner().invoke(app, [*words, "8GB", "--levels", "auto"])
    cost, more = json.loads(large.stdout), json.loads(with_levels.stdout)
    assert 1.35 == pytest.approx(more["file_bytes"] / cost["file_bytes"], abs=0.001)
    assert more["seconds"] > cost["seconds"]
    assert large.stderr.startswith(
        "viewers show a scene of 3,000,000 splats sooner with levels of detail: --levels auto"
    )
    assert large.stderr.endswith(" more, 35 % more bytes)\n")
    assert "" == with_levels.stderr == CliRunner().invoke(app, [*words, "8GB", "--quiet"]).stderr


def test_only_large_files_may_exceed_the_memory(ply, tmp_path):
    def may_leave(path, size, **limits):
        os.truncate(path, size)  # a sparse file
        return may_exceed_memory(path, OutOfCoreOptions(**limits))

    assert not may_leave(ply, 4 << 20, memory_bytes=1)
    assert may_leave(ply, 5 << 20, memory_bytes=19 << 20)
    assert not may_leave(ply, 5 << 20, memory_bytes=21 << 20)
    assert may_leave(ply, 4 << 20, memory_bytes=1, resume=True)
    csplat_file = tmp_path / "scene.csplat"
    csplat_file.write_bytes(b"CSPLAT")
    assert may_leave(csplat_file, 5 << 20, memory_bytes=1 << 40)  # its decoded size is unknown
