# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.buckets."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from large_cases import COUNT, WHOLE
from models import with_facts

from csplat.encoder import buckets
from csplat.encoder.buckets import BucketCurve, bucket_rows
from csplat.ply import read_ply


@pytest.fixture(scope="module")
def model(sample_path):
    sample, rng = read_ply(sample_path), np.random.default_rng(5)
    many = sample.select(rng.integers(0, len(sample), COUNT))
    means = many.means + rng.normal(0, 0.05, many.means.shape).astype(np.float32)
    extra = {"confidence": np.arange(COUNT, dtype=np.uint16)}
    return with_facts(replace(many, means=means, extra=extra), entries={"licence": "CC0"})


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
    assert 1 == BucketCurve.through(np.zeros((10, 3), np.float32), WHOLE, WHOLE).count  # a small scene has one bucket
