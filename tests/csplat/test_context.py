# SPDX-License-Identifier: Apache-2.0
"""The context of work: its ranges and defaults."""

import numpy as np
import pytest

from csplat import Context, InputError, encode
from csplat.context import DEFAULT_CONTEXT
from csplat.system import core_count


@pytest.mark.parametrize(
    "field", [{"threads": 0}, {"threads": 1.5}, {"workers": 0}, {"seed": -1}, {"seed": True}, {"seed": None}]
)
def test_a_number_out_of_range_is_refused(field):
    with pytest.raises(InputError, match=f"^{next(iter(field))} is .*, expected an integer of at least"):
        Context(**field)


def test_the_default_uses_all_cores_and_half_of_the_free_memory(monkeypatch):
    monkeypatch.setattr("csplat.system.available_memory_bytes", lambda: 1000)
    assert core_count() == DEFAULT_CONTEXT.thread_count
    assert (3, 500) == (Context(threads=np.int64(3)).thread_count, DEFAULT_CONTEXT.memory_limit)
    assert 7000 == Context(memory="7 kB").memory_limit


def test_memory_workers_and_resuming_concern_encodings_on_disk():
    assert [False, True, True, True] == [
        context.is_bounded
        for context in (
            Context(threads=2, seed=1),
            Context(memory=1),
            Context(workers="tcp://host:1"),
            Context(resume=True),
        )
    ]


def test_numbers_of_numpy_become_pythons(make_model):
    context = Context(threads=np.int64(2), seed=np.int64(3))
    assert (int, int) == (type(context.threads), type(context.seed))
    assert encode(make_model(50, 0), context=Context(seed=3)) == encode(make_model(50, 0), context=context)
