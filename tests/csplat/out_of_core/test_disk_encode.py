# SPDX-License-Identifier: Apache-2.0
"""Out-of-core encoding: the same bytes as in memory, resumed runs, full disks, lost workers.

Also: csplat.out_of_core.bucket_workers, csplat.out_of_core.disk_buckets.
"""

import errno
import multiprocessing
import os
import resource
import shutil
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from large_cases import COUNT, FAST, WHOLE, EveryFourth, Interrupt, encode_large
from models import with_facts

import csplat
from csplat import Context, EncodeOptions, InputError, decode, encode, encode_with_report, write_ply
from csplat.out_of_core import estimate_cost
from csplat.ply import read_ply
from csplat.scene import Scene
from csplat_conformance.validator import validate
from csplat_tools.encode_file import encode_file
from csplat_tools.scene_files import with_first_view

pytestmark = pytest.mark.filterwarnings("ignore:extra columns confidence are dropped")  # files must be alike without


@pytest.fixture(scope="module")
def model(sample_path):
    sample, rng = read_ply(sample_path), np.random.default_rng(5)
    many = sample.select(rng.integers(0, len(sample), COUNT))
    means = many.means + rng.normal(0, 0.05, many.means.shape).astype(np.float32)
    extra = {"confidence": np.arange(COUNT, dtype=np.uint16)}
    return with_facts(replace(many, means=means, extra=extra), entries={"licence": "CC0"})


@pytest.fixture(scope="module")
def whole(model):
    """The file of the scene, encoded in memory."""
    return encode(model, FAST)


@pytest.mark.slow
def test_a_file_of_many_buckets_is_valid_with_declared_errors(model, whole):
    assert validate(whole).conforms
    result = encode_with_report(model, FAST)
    assert COUNT == len(np.unique(result.source_index))
    decoded = decode(result.data)
    distance = np.linalg.norm(decoded.means - model.means[result.source_index], axis=1)
    assert distance.max() <= result.report.errors["means"][0]
    assert 7 <= result.report.tile_count <= 12


@pytest.mark.slow
def test_each_bucket_is_a_subtree_of_the_levels(model, whole, tmp_path):
    encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, levels=EveryFourth())
    with_levels = (tmp_path / "out.csplat").read_bytes()
    assert validate(with_levels).conforms
    with csplat.open(with_levels) as file:
        counts = [sum(node.splat_count for node in file.nodes if node.level == level) for level in range(3)]
        assert COUNT == counts[0]
        assert COUNT / 4 <= counts[1] < COUNT / 4 + len(file.nodes)
        assert 1 == sum(node.parent is None for node in file.nodes)
        assert {0.0, 1.0, 2.0} == {node.error for node in file.nodes}
    for name in ("means", "opacities", "sh0"):  # level 0 has the same steps
        assert np.array_equal(getattr(decode(whole), name), getattr(decode(with_levels), name))


@pytest.mark.slow
def test_an_out_of_core_encoding_is_resumed_with_more_memory(model, whole, tmp_path):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(Scene.of(model), target, FAST, progress=Interrupt("coding", after=2))
    stages = []
    encode(model, FAST, out=target, context=Context(resume=True, progress=lambda stage, _done: stages.append(stage)))
    assert "coding" in stages
    assert "sorting" not in stages
    assert whole == target.read_bytes()
    assert [target] == list(tmp_path.iterdir())


@pytest.fixture
def ply(model, tmp_path):
    write_ply(tmp_path / "scene.ply", with_facts(replace(model, extra={}), entries={}))
    return tmp_path / "scene.ply"


@pytest.mark.slow
def test_a_file_is_encoded_out_of_core_on_request(ply, tmp_path):
    target, stages = tmp_path / "out.csplat", set()
    options = EncodeOptions(preset="fast", sh_degree=1, bucket_splats=WHOLE)
    context = Context(memory=300_000_000, workers=1, progress=lambda stage, _done: stages.add(stage))
    with csplat.open(ply) as scene:
        cost = estimate_cost(scene, options, context)
    assert (COUNT, 1, False) == (cost.splats, cost.sh_degree, cost.in_memory)
    assert 0 < cost.memory_bytes <= 300e6
    encoded = encode_file(str(ply), str(target), options, context=context)
    assert {"sorting", "coding"} <= stages
    assert encoded.result.size_bytes == target.stat().st_size
    with csplat.open(ply) as scene:
        assert encode(with_first_view(scene).model(), options) == target.read_bytes()


@pytest.mark.slow
def test_out_of_core_encoding_gives_the_bytes_of_memory(model, whole, tmp_path):
    stages = {}
    note = lambda stage, done: stages.update({stage: done})  # noqa: E731
    report = encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, progress=note)
    assert whole == (tmp_path / "out.csplat").read_bytes()
    assert ["out.csplat"] == [path.name for path in tmp_path.iterdir()]
    assert (len(model), len(whole)) == (report.splat_count, report.size_bytes)
    assert {"looking", "sorting", "codebook", "coding", "writing"} == set(stages)
    assert 1.0 == stages["looking"] == stages["sorting"] == stages["coding"]


@pytest.fixture(scope="module")
def with_levels(model, tmp_path_factory):
    """The file of the scene with levels of detail."""
    path = tmp_path_factory.mktemp("levels") / "out.csplat"
    encode_large(Scene.of(model), path, FAST, levels=EveryFourth())
    return path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("memory", [None, 900_000_000])
def test_levels_do_not_depend_on_processes_or_memory(model, with_levels, tmp_path, memory):
    target = tmp_path / "out.csplat"
    encode_large(Scene.of(model), target, FAST, workers=2, levels=EveryFourth(), memory=memory)
    assert with_levels == target.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "after"), [("sorting", 0), ("coding", 3), ("writing", 0)])
def test_an_interrupted_encoding_with_levels_is_resumed(model, with_levels, tmp_path, stage, after):
    target, scene = tmp_path / "out.csplat", Scene.of(model)
    with pytest.raises(KeyboardInterrupt):
        encode_large(scene, target, FAST, levels=EveryFourth(), progress=Interrupt(stage, after=after))
    assert not target.exists()
    with pytest.raises(InputError, match="was started with levels"):
        encode_large(scene, target, FAST, resume=True)
    encode_large(scene, target, FAST, levels=EveryFourth(), resume=True)
    assert with_levels == target.read_bytes()
    assert [target] == list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_disk_that_fills_up_while_levels_are_written_is_reported(model, with_levels, tmp_path):
    target, before = tmp_path / "out.csplat", resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, _done):
        if stage == "coding":
            resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, before[1]))

    try:
        with pytest.raises(OSError, match="File too large"):
            encode_large(Scene.of(model), target, FAST, levels=EveryFourth(), progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not target.exists()
    assert not list((tmp_path / "out.csplat.work").glob("*.part*"))
    encode_large(Scene.of(model), target, FAST, levels=EveryFourth(), resume=True)
    assert with_levels == target.read_bytes()


def test_a_scene_built_in_one_piece_requires_its_memory(model, tmp_path):
    with pytest.raises(InputError, match="300 MB of memory are too little for this scene, which requires 3"):
        encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, levels=EveryFourth(COUNT), memory=300_000_000)


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(model, whole, tmp_path):
    encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, workers=2)
    assert whole == (tmp_path / "out.csplat").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        EncodeOptions(preset="fast", sh_coding="scalar", keep_extra=True, bucket_splats=WHOLE),
        EncodeOptions(preset="small", sh_degree=0, bucket_splats=WHOLE),
        EncodeOptions(preset="fast", sh_degree=1, adaptive=0.5, tile_splats=300, bucket_splats=WHOLE),
    ],
)
def test_options_give_the_bytes_of_memory(model, options, tmp_path):
    encode_large(Scene.of(model), tmp_path / "out.csplat", options)
    assert encode(model, options) == (tmp_path / "out.csplat").read_bytes()


@pytest.mark.slow
def test_tiles_are_as_large_as_the_whole_scene_requires(make_model, tmp_path):
    model, options = make_model(200_000, 0), EncodeOptions(preset="fast", bucket_splats=50_000)
    report = encode_large(Scene.of(model), tmp_path / "out.csplat", options)
    assert encode(model, options) == (tmp_path / "out.csplat").read_bytes()
    assert 10 == report.tile_count  # buckets of 40,000, of two tiles each; those of the sample have at most 16,384


@pytest.mark.slow
def test_doubles_and_huge_values_give_the_bytes_of_memory(model, tmp_path):
    origin = (4.5e5, 5.4e6, 100.0)
    doubles = model.means.astype(np.float64) + np.array(origin) + 1e-9
    scales, shN = model.scales.copy(), model.shN.copy()
    scales[17], scales[1600], shN[3200] = 95.0, 1e5, 3e8
    means = (doubles - np.array(origin)).astype(np.float32)
    hard = replace(model, means=means, origin=origin, means_double=doubles, scales=scales, shN=shN)
    options = EncodeOptions(preset="fast", sh_degree=1, bucket_splats=WHOLE)
    encode_large(Scene.of(hard), tmp_path / "out.csplat", options)
    assert encode(hard, options) == (tmp_path / "out.csplat").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "after"), [("looking", 0), ("sorting", 0), ("codebook", 0), ("coding", 3)])
def test_an_interrupted_encoding_is_resumed(model, whole, tmp_path, stage, after):
    target, scene = tmp_path / "out.csplat", Scene.of(model)
    with pytest.raises(KeyboardInterrupt):
        encode_large(scene, target, FAST, progress=Interrupt(stage, after=after))
    assert not target.exists()
    assert (tmp_path / "out.csplat.work").is_dir()
    with pytest.raises(InputError, match="left from an interrupted encoding"):
        encode_large(scene, target, FAST)
    with pytest.raises(
        InputError, match=r"started with options .*: continue with the former options, or remove the folder"
    ):
        encode_large(scene, target, FAST, seed=1, resume=True)
    coded = []
    encode_large(scene, target, FAST, resume=True, progress=lambda stage, _done: coded.append(stage))
    assert whole == target.read_bytes()
    if stage == "coding":
        assert "sorting" not in coded
    assert [target] == list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_encoding_with_a_killed_worker_is_resumed(model, whole, tmp_path):
    target = tmp_path / "out.csplat"

    def kill(stage, _done):
        if stage == "coding":
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)

    with pytest.raises(OSError, match="a worker process was killed") as error:
        encode_large(Scene.of(model), target, FAST, workers=2, progress=kill)
    assert errno.ENOMEM == error.value.errno
    assert not target.exists()
    encode_large(Scene.of(model), target, FAST, workers=2, resume=True)
    assert whole == target.read_bytes()


def test_a_full_disk_is_reported_and_the_encoding_resumed(model, whole, tmp_path, monkeypatch):
    target = tmp_path / "out.csplat"
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=1000))
        with pytest.raises(InputError, match="0 MB free, 1 MB are needed"):
            encode_large(Scene.of(model), target, FAST)
    assert not list(tmp_path.iterdir())
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, _done):
        if stage == "sorting":  # a part of each bucket can be written
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))

    try:
        with pytest.raises(OSError, match="File too large"):
            encode_large(Scene.of(model), target, FAST, progress=fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not target.exists()
    assert [10_000] == [path.stat().st_size for path in (tmp_path / "out.csplat.work").glob("section-*")]
    encode_large(Scene.of(model), target, FAST, resume=True)
    assert whole == target.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sample", "section-000003", "tiles-000001", "state.json"])
def test_a_damaged_work_file_is_named(model, tmp_path, kind):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(Scene.of(model), target, FAST, progress=Interrupt("coding", after=2))
    path = tmp_path / "out.csplat.work" / kind
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if kind != "state.json" else 0] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"{kind} is damaged: remove out.csplat.work"):
        encode_large(Scene.of(model), target, FAST, resume=True)
    assert not target.exists()


def test_a_folder_with_other_fields_of_state_is_refused(model, tmp_path):
    target = tmp_path / "out.csplat"
    with pytest.raises(KeyboardInterrupt):
        encode_large(Scene.of(model), target, FAST, progress=Interrupt("coding"))
    path = tmp_path / "out.csplat.work" / "state.json"
    path.write_text(path.read_text().replace("largest_sh", "largest"))
    with pytest.raises(InputError, match=r"state\.json is damaged: remove out.csplat.work"):
        encode_large(Scene.of(model), target, FAST, resume=True)


def test_a_folder_with_other_files_is_refused_and_kept(model, tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "one.jpg").write_bytes(b"dear to somebody")
    for resume in (False, True):
        with pytest.raises(InputError, match="photographs is not empty"):
            encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, folder=folder, resume=resume)
    assert b"dear to somebody" == (folder / "one.jpg").read_bytes()


def test_a_scene_that_shrinks_while_it_is_read_is_refused(model, tmp_path):
    times = []

    def blocks():
        times.append(1)
        yield model.select(slice(0, COUNT if len(times) == 1 else 3000))

    with pytest.raises(InputError, match="the scene has 3,000 splats, expected 3,600"):
        encode_large(Scene.of(model).changed(reader=blocks), tmp_path / "out.csplat", FAST)
    assert not (tmp_path / "out.csplat").exists()


def test_too_little_memory_is_refused(model, tmp_path):
    with pytest.raises(InputError, match="100 MB of memory are too little for this scene, which requires 2"):
        encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, memory="100MB")
    with pytest.raises(InputError, match="a codebook of shapes requires the scene in memory"):
        encode_large(Scene.of(model), tmp_path / "out.csplat", replace(FAST, shape_codebook_size=64))
    assert not list(tmp_path.iterdir())


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

        encode_large(Scene.of(model), target, FAST, workers=cluster.scheduler_address, progress=kill)
        assert not victims
        assert whole == target.read_bytes()
        encode_large(Scene.of(model), target, FAST, workers=cluster.scheduler_address, levels=EveryFourth())
    assert with_levels == target.read_bytes()


@pytest.mark.remote
def test_an_unreachable_cluster_is_reported(model, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="a cluster requires the extra [scale]")
    monkeypatch.setattr(distributed, "Client", partial_client(distributed.Client))
    with pytest.raises(OSError, match=r"127\.0\.0\.1:9"):
        encode_large(Scene.of(model), tmp_path / "out.csplat", FAST, workers="tcp://127.0.0.1:9")


def partial_client(client):
    return lambda address, **options: client(address, **{**options, "timeout": 0.2})
