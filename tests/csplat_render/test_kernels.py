# SPDX-License-Identifier: Apache-2.0
"""Kernels: numbers of threads, calls by several threads and by a forked child, an instruction set that is absent."""

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render import kernels
from csplat_render.kernels import available_threads, thread_count
from csplat_render.neighbours import nearest_neighbours

POINTS = np.random.default_rng(0).normal(size=(3000, 3))


def test_the_number_of_threads_is_limited_and_restored():
    with thread_count(1):
        with pytest.raises(InputError, match="threads is 0, expected 1 or more"), thread_count(0):
            pass
        with thread_count(available_threads() + 1) as threads:
            assert available_threads() == threads
        with thread_count(None) as threads:
            assert 1 == threads


def in_child(call):
    """Return the exit status of a forked child that calls a function; a child that waits for ever is ended."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(20)
    try:
        call()
        os._exit(7)
    finally:
        os._exit(1)


@pytest.mark.filterwarnings("ignore:.*fork")  # Python warns of forks among threads, which are the point
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
def test_a_forked_child_has_its_own_threads():
    def search():
        with thread_count(available_threads()):
            assert np.array_equal(expected, nearest_neighbours(POINTS, 3)[0])

    def search_on():
        while not done.is_set():
            search()

    with thread_count(1):
        expected, _ = nearest_neighbours(POINTS, 3)
    search()
    assert 7 == in_child(search)
    done, other = threading.Event(), threading.Thread(target=search_on)
    other.start()  # the fork may happen while this thread has the library's threads
    statuses = {in_child(search) for _ in range(5)}
    done.set()
    other.join()
    assert {7} == statuses


def test_several_threads_may_call_at_once():
    expected, found = nearest_neighbours(POINTS, 3), [None] * 4

    def search(number):
        with thread_count(1 + number % 2):
            for _ in range(5):
                found[number] = nearest_neighbours(POINTS, 3)

    threads = [threading.Thread(target=search, args=[number]) for number in range(len(found))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(expected, each) for each in found)


@pytest.mark.slow
def test_an_absent_instruction_set_is_an_error_in_one_line():
    assert kernels.require_library() in kernels.INSTRUCTION_SETS
    code = """
from csplat.errors import InputError
from csplat_render import kernels
for call in (kernels.require_library, lambda: kernels.call("nearest_neighbours")):
    try:
        call()
    except InputError as error:
        print(error)
"""
    environment = {**os.environ, kernels.SET_VARIABLE: "absent"}
    printed = subprocess.check_output([sys.executable, "-c", code], text=True, env=environment)
    line = "CSPLAT_INSTRUCTION_SET is 'absent', expected one that this installation and processor have"
    assert [line] * 2 == printed.splitlines()
