"""Out-of-core encoding: the same bytes as in memory, resumed runs, full disks, lost workers."""

import os
from dataclasses import replace

import numpy as np
import pytest
from large_cases import COUNT, FAST, WHOLE, EveryFourth, Interrupt, encode_large

from csplat import EncodeOptions, decode, encode, encode_with_report, read_ply, write_ply
from csplat import open as csplat_open
from csplat.formats import open_scene
from csplat.out_of_core import OutOfCoreOptions, encode_scene, estimate_cost
from csplat.scene_source import source_from_model
from csplat_conformance.validator import validate
from csplat_tools.encode_file import encode_file, may_exceed_memory


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
    encode_large(source_from_model(model), tmp_path / "out.csplat", FAST, levels=EveryFourth())
    with_levels = (tmp_path / "out.csplat").read_bytes()
    assert validate(with_levels).conforms
    with csplat_open(with_levels) as file:
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
        encode_large(source_from_model(model), target, FAST, progress=Interrupt("coding", after=2))
    stages, resume = [], OutOfCoreOptions(resume=True)
    encode_scene(source_from_model(model), target, FAST, resume, progress=lambda stage, _done: stages.append(stage))
    assert "coding" in stages
    assert "sorting" not in stages
    assert whole == target.read_bytes()
    assert [target] == list(tmp_path.iterdir())


@pytest.fixture
def ply(model, tmp_path):
    write_ply(tmp_path / "scene.ply", replace(model, extra={}, metadata={}))
    return tmp_path / "scene.ply"


@pytest.mark.slow
def test_a_file_is_encoded_out_of_core_on_request(ply, tmp_path):
    target, limits = tmp_path / "out.csplat", OutOfCoreOptions(memory_bytes=300_000_000, always=True)
    options = EncodeOptions(preset="fast", sh_degree=1, threads=1, bucket_splats=WHOLE)
    with open_scene(ply) as scene:
        cost = estimate_cost(scene, options, limits)
    assert (COUNT, 1, False) == (cost.splats, cost.sh_degree, cost.in_memory)
    assert 0 < cost.memory_bytes <= 300e6
    stages = set()
    encoded = encode_file(
        str(ply), str(target), options, out_of_core=limits, progress=lambda stage, _done: stages.add(stage)
    )
    assert {"sorting", "coding"} <= stages
    assert encoded.report.size_bytes == target.stat().st_size
    with open_scene(ply) as scene:
        assert encode(scene.model(), options) == target.read_bytes()


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
