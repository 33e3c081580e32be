"""Blocks and threads: every row once, and no result that depends on how many threads there are."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Iterator

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.backends import system_compiler

from elastocal.model import BatchFunction, c_engine, row_blocks, run_blocks, thread_count
from elastocal.model.evaluate import CHUNK, ahead


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ELASTOCAL_CACHE", str(tmp_path_factory.mktemp("cache")))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(n=st.integers(0, 3000), size=st.integers(1, 400))
def test_blocks_cover_every_row_once_and_are_even(n: int, size: int) -> None:
    blocks = row_blocks(n, size)
    rows = [row for block in blocks for row in range(block.start, block.stop)]
    assert rows == list(range(n))
    lengths = [block.stop - block.start for block in blocks]
    assert max(lengths, default=0) <= size
    assert not lengths or max(lengths) - min(lengths) <= 1


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(n=st.integers(0, 40), threads=st.integers(1, 9))
def test_every_block_is_worked_on_once(n: int, threads: int) -> None:
    done: list[slice] = []
    run_blocks(done.extend, row_blocks(n, 1), threads)
    assert sorted(block.start for block in done) == list(range(n))


def test_as_many_threads_as_asked_for() -> None:
    together = threading.Barrier(3)  # passed only where three threads wait at once
    run_blocks(lambda share: together.wait(timeout=60) and None, row_blocks(6, 1), 3)


@pytest.mark.parametrize("threads", [1, 3])
def test_items_are_made_in_the_callers_thread_and_results_come_in_order(threads: int) -> None:
    makers = []

    def items() -> Iterator[int]:
        for k in range(20):
            makers.append(threading.current_thread())
            yield k

    assert list(ahead(lambda k: k**2, items(), threads)) == [k**2 for k in range(20)]
    assert set(makers) == {threading.current_thread()}


def test_an_error_in_a_thread_is_the_callers() -> None:
    def fail(share: object) -> None:
        raise ZeroDivisionError("in a thread")

    with pytest.raises(ZeroDivisionError, match="in a thread"):
        run_blocks(fail, row_blocks(6, 1), 3)


@pytest.mark.parametrize("value, expected", [("3", 3), ("5,2", 5)])
def test_omp_num_threads_is_obeyed(
    monkeypatch: pytest.MonkeyPatch, value: str, expected: int
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert thread_count() == expected


@pytest.mark.parametrize("value", ["", "0", "many"])
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
def test_else_the_cores_of_this_process(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2, 5, 7})
    assert thread_count() == 4


def mixed() -> tuple[list[ca.SX], list[ca.SX]]:
    """Operations whose numpy versions treat the ends of an array by other code than its middle."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p")
    y = ca.vertcat(ca.sin(x[0] * p), ca.exp(x[1]), ca.atan2(x[2], x[0]), (1 + x[1] ** 2) ** 2.5)
    return [x, p], [y, ca.jacobian(y, x)]


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_results_do_not_depend_on_the_number_of_threads(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if backend == "compiled":
        system_compiler()
    monkeypatch.setattr(c_engine, "WORK_OF_A_THREAD", 1)
    x = np.abs(np.random.default_rng(0).normal(size=(3 * CHUNK + 17, 3)))
    found = {}
    for threads in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
        function = BatchFunction(*mixed(), backend)
        found[threads] = function(x, np.array([1.7]))
        assert function.report.threads == threads
    for one, three in zip(found[1], found[3], strict=True):
        assert one.tobytes() == three.tobytes()


def test_small_tables_use_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    for backend in ("numpy", "compiled"):
        if backend == "compiled":
            system_compiler()
        function = BatchFunction(*mixed(), backend)
        function(np.ones((300, 3)), np.ones(1))
        assert function.report.threads == 1


def test_a_thread_of_the_callers_own_is_not_divided_further(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    function = BatchFunction(*mixed(), "numpy")
    other = threading.Thread(target=function, args=(np.ones((3 * CHUNK, 3)), np.ones(1)))
    other.start()
    other.join()
    assert function.report.threads == 1


def test_threads_take_over_the_callers_errstate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    x = ca.SX.sym("x")
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("error")
        found = BatchFunction([x], [1 / x], "numpy")(np.zeros((3 * CHUNK, 1)))[0]
    assert np.isinf(found).all()


def test_one_tape_may_be_called_by_several_threads() -> None:
    function, x = BatchFunction(*mixed(), "numpy"), np.random.default_rng(1).uniform(0, 1, (500, 3))
    expected = function(x, np.ones(1))
    found: list = [None] * 8

    def call(k: int) -> None:
        found[k] = function(x, np.ones(1))

    callers = [threading.Thread(target=call, args=(k,)) for k in range(len(found))]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    for results in found:
        for one, other in zip(results, expected, strict=True):
            np.testing.assert_array_equal(one, other)
