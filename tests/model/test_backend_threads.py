"""Blocks and threads: every row once, and no result that depends on how many threads there are."""

from __future__ import annotations

import threading

import casadi as ca
import numpy as np
import pytest

from elastocal.model.evaluate import CHUNK, BatchFunction, thread_count


@pytest.mark.parametrize("value, expected", [("3", 3), ("5,2", 5)])
def test_omp_num_threads_is_obeyed(
    monkeypatch: pytest.MonkeyPatch, value: str, expected: int
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert thread_count() == expected


def mixed() -> tuple[list[ca.SX], list[ca.SX]]:
    """Operations whose numpy versions treat the ends of an array by other code than its middle."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p")
    y = ca.vertcat(ca.sin(x[0] * p), ca.exp(x[1]), ca.atan2(x[2], x[0]), (1 + x[1] ** 2) ** 2.5)
    return [x, p], [y, ca.jacobian(y, x)]


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.abs(np.random.default_rng(0).normal(size=(3 * CHUNK + 17, 3)))
    found = {}
    for threads in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
        function = BatchFunction(*mixed(), "numpy")
        found[threads] = function(x, np.array([1.7]))
    for one, three in zip(found[1], found[3], strict=True):
        assert one.tobytes() == three.tobytes()


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
