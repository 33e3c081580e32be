"""Which engine evaluates a function: asked for, chosen by rule, refused, and reported."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain

from elastocal.errors import InputError
from elastocal.model.evaluate import FEW, BatchFunction, chosen_backend
from elastocal.model.manipulator import Model

X = ca.SX.sym("x", 2)
ROWS = np.linspace(0.1, 2.0, 20).reshape(10, 2)
MANY = np.linspace(0.1, 2.0, 2 * FEW + 2).reshape(FEW + 1, 2)  # too many for CasADi row by row


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """No choice of another test."""
    monkeypatch.delenv("ELASTOCAL_BACKEND", raising=False)


def by_numpy(f: BatchFunction) -> bool:
    """Whether numpy's instructions were asked for."""
    return "_by_numpy" in vars(f)


def function(backend: str | None = None) -> BatchFunction:
    return BatchFunction([X], [ca.vertcat(ca.sin(X[0]) * X[1], X[0] / X[1])], backend)


def test_argument_before_environment_before_auto(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen_backend() == "auto"
    monkeypatch.setenv("ELASTOCAL_BACKEND", "numpy")
    assert chosen_backend() == "numpy"
    assert chosen_backend("auto") == "auto"


def test_an_unknown_name_is_refused_with_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"backend: unknown backend 'nunpy'.*'numpy'"):
        function("nunpy")
    with pytest.raises(InputError, match="unknown backend 'fortran'; valid: auto, numpy"):
        function("fortran")
    monkeypatch.setenv("ELASTOCAL_BACKEND", "compiled")
    with pytest.raises(InputError, match=r"ELASTOCAL_BACKEND in the environment: .*take auto"):
        function()(ROWS)


def test_few_rows_are_evaluated_by_casadi_as_by_numpy() -> None:
    """Sparse outputs, what is the same in all rows, no row at all; and no more of them than pay."""
    p = ca.SX.sym("p", 2)
    sparse = ca.diagcat(X[0] * p[1], ca.atan2(X[1], p[0]), ca.if_else(X[0] > 1, X[1] ** 3, 0))
    few, plain = (BatchFunction([X, p], [sparse, X + p], name) for name in (None, "numpy"))
    for n in (0, 1, 10):
        for found, expected in zip(*(f(ROWS[:n], ROWS[3]) for f in (few, plain)), strict=True):
            np.testing.assert_array_equal(found, expected)
    few(MANY[:-1], ROWS[3])
    assert by_numpy(plain) and not by_numpy(few)
    few(MANY, ROWS[3])
    assert by_numpy(few)


def test_complex_numbers_are_evaluated_by_numpy() -> None:
    auto = function()
    found = auto(ROWS + 1e-30j)[0]
    assert by_numpy(auto)
    expected = np.cos(ROWS[:, 0]) * ROWS[:, 1] + np.sin(ROWS[:, 0])
    np.testing.assert_allclose(found[:, 0, 0].imag / 1e-30, expected, rtol=1e-14)


@pytest.mark.parametrize("wrong", [
    (), (ROWS, ROWS), (ROWS[:, :1],), (ROWS[None],), (np.ones(3),), (np.float64(1),),
])  # fmt: skip
def test_arrays_of_other_shapes_are_refused(wrong: tuple) -> None:
    for backend in ("auto", "numpy"):
        with pytest.raises(ValueError, match="per row"):
            function(backend)(*wrong)


def test_a_model_reports_what_evaluates_it() -> None:
    for backend, told in (("auto", "casadi for few rows, else numpy ("), ("numpy", "numpy (")):
        model = Model.assembled(kr270_chain(), kr270_cell(["joint_compliance"]), backend=backend)
        assert model.backend_report().startswith(told)


def test_a_function_travels_to_another_process() -> None:
    for backend in ("auto", "numpy"):
        sent = function(backend)
        expected = sent(ROWS)[0]
        arrived = pickle.loads(pickle.dumps(sent))
        np.testing.assert_array_equal(arrived(ROWS)[0], expected)
        assert by_numpy(arrived) is (backend == "numpy")
