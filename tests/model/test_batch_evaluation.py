"""Evaluation of arrays is what CasADi computes: operations, chunks, engines, threads."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.messages import InputError
from elastocal.model.evaluate import CHUNK, FEW, ONCE, BatchFunction, chosen_backend

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


def built(tree, symbols: Mapping[str, ca.SX], operations: Mapping[str, ca.SX]) -> ca.SX:
    """A tree of symbols' names, numbers and (operation, operand, ...) as an expression.

    `operations` are expressions in X, or in X and Y.
    """
    if isinstance(tree, str):
        return symbols[tree]
    if isinstance(tree, float):
        return ca.SX(tree)
    operation, *operands = tree
    parts = [built(operand, symbols, operations) for operand in operands]
    return ca.substitute(
        operations[operation], ca.vertcat(*[X, Y][: len(parts)]), ca.vertcat(*parts)
    )


UNARY = {
    "neg": -X, "exp": ca.exp(X), "log": ca.log(X), "sqrt": ca.sqrt(X), "sq": X * X,
    "sin": ca.sin(X), "cos": ca.cos(X), "tan": ca.tan(X), "asin": ca.asin(X / 4),
    "acos": ca.acos(X / 4), "atan": ca.atan(X), "fabs": ca.fabs(X), "sign": ca.sign(X),
    "sinh": ca.sinh(X), "cosh": ca.cosh(X), "tanh": ca.tanh(X), "inv": 1 / X,
    "log1p": ca.log1p(X), "expm1": ca.expm1(X), "floor": ca.floor(X), "ceil": ca.ceil(X),
    "twice": 2 * X, "identity": X, "power 3": X**3, "power 2.5": X**2.5, "constant": X * 0 + 3,
}  # fmt: skip
BINARY = {
    "add": X + Y, "sub": X - Y, "mul": X * Y, "div": X / Y, "pow": X**Y,
    "atan2": ca.atan2(X, Y), "fmin": ca.fmin(X, Y), "fmax": ca.fmax(X, Y),
    "hypot": ca.hypot(X, Y), "fmod": ca.fmod(X, Y), "lt": X < Y, "le": X <= Y, "eq": X == Y,
    "ne": X != Y, "and": ca.logic_and(X, Y), "or": ca.logic_or(X, Y),
    "copysign": ca.copysign(X, Y), "if_else_zero": ca.if_else(X > Y, X, 0),
}  # fmt: skip

# Equal operands, zeros, half-integers and both signs: where comparisons and rounding decide.
POINTS = np.array(
    [[a, b] for a in (-2.5, -1.0, 0.0, 0.5, 2.0, 3.25) for b in (-2.0, -0.5, 0.0, 0.5, 2.0)]
)


def casadi_values(inputs: list[ca.SX], output: ca.SX, *values: np.ndarray) -> np.ndarray:
    function = ca.Function("f", inputs, [output])
    n = max(len(v) for v in values if v.ndim == 2)
    rows = [[v[i] if v.ndim == 2 else v for v in values] for i in range(n)]
    return np.array([function(*row).full() for row in rows])


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_every_operation(name: str) -> None:
    """NaN and infinity included: log(−1), 1/0."""
    output, values = {**UNARY, **BINARY}[name], (POINTS[:, :1], POINTS[:, 1:])
    with np.errstate(all="ignore"):
        found = BatchFunction([X, Y], [output], "numpy")(*values)[0]
    expected = casadi_values([X, Y], output, *values)
    np.testing.assert_allclose(found, expected, rtol=4e-15, atol=1e-300)


numbers = st.floats(-3, 3, allow_subnormal=False)
leaves = st.sampled_from(["x", "y", "p"]) | numbers.map(lambda v: round(v, 2))
smooth = ("sin", "cos", "tanh", "atan", "fabs", "sign", "neg", "sq", "floor")
paired = ("add", "sub", "mul", "fmin", "fmax", "atan2", "if_else_zero", "hypot")
expressions = st.recursive(
    leaves,
    lambda inner: (
        st.tuples(st.sampled_from(smooth), inner) | st.tuples(st.sampled_from(paired), inner, inner)
    ),
    max_leaves=25,
)


@given(tree=expressions, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_random_expressions_and_their_derivatives(tree, seed: int) -> None:
    """x and y vary by row, p is the same in all: registers of both sorts get reused."""
    symbols = {name: ca.SX.sym(name) for name in "xyp"}
    expression = built(tree, symbols, {**UNARY, **BINARY})
    inputs = list(symbols.values())
    slopes = ca.jacobian(expression, ca.vertcat(*inputs))
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=(5, 1)), rng.normal(size=(5, 1)), rng.normal(size=1))
    for output in (expression, slopes):
        with np.errstate(all="ignore"):
            found = BatchFunction(inputs, [output])(*values)[0]
        expected = casadi_values(inputs, output, *values)
        defined = np.isfinite(expected)
        # Common subexpressions change the order of additions, hence the absolute part.
        tolerance = 1e-12 * max(1.0, np.abs(expected[defined]).max(initial=0.0))
        np.testing.assert_allclose(found[defined], expected[defined], rtol=0, atol=tolerance)


# --- engines

PAIR = ca.SX.sym("x", 2)
ROWS = np.linspace(0.1, 2.0, 20).reshape(10, 2)
MANY = np.linspace(0.1, 2.0, 2 * FEW + 2).reshape(FEW + 1, 2)  # too many for CasADi row by row


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ELASTOCAL_BACKEND", raising=False)


def by_numpy(f: BatchFunction) -> bool:
    return "_by_numpy" in vars(f)


def function(backend: str | None = None) -> BatchFunction:
    return BatchFunction(
        [PAIR], [ca.vertcat(ca.sin(PAIR[0]) * PAIR[1], PAIR[0] / PAIR[1])], backend
    )


def test_an_unknown_name_is_refused_with_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"backend: unknown backend 'nunpy'.*'numpy'"):
        function("nunpy")
    with pytest.raises(InputError, match="unknown backend 'fortran'; valid: auto, numpy"):
        function("fortran")
    monkeypatch.setenv("ELASTOCAL_BACKEND", "compiled")
    with pytest.raises(InputError, match=r"ELASTOCAL_BACKEND in the environment: .*take auto"):
        function()(ROWS)
    monkeypatch.setenv("ELASTOCAL_BACKEND", "numpy")
    assert (chosen_backend(), chosen_backend("auto")) == ("numpy", "auto")


def test_few_rows_are_evaluated_by_casadi_as_by_numpy() -> None:
    """Sparse outputs, what is the same in all rows, no row at all; and no more of them than pay."""
    p = ca.SX.sym("p", 2)
    diagonal = ca.diagcat(ca.atan2(PAIR[1], p[0]), ca.if_else(PAIR[0] > 1, PAIR[1] ** 3, 0))
    sparse = ca.vertcat(diagonal, ca.horzcat(PAIR[0] * p[1], 0), ca.horzcat(0, PAIR[1]))
    few, plain = (BatchFunction([PAIR, p], [sparse, PAIR + p], name) for name in (None, "numpy"))
    for n in (0, 1, 10):
        for found, expected in zip(*(f(ROWS[:n], ROWS[3]) for f in (few, plain)), strict=True):
            np.testing.assert_array_equal(found, expected)
    assert by_numpy(plain) and not by_numpy(few)
    once = BatchFunction([PAIR, p], [sparse, PAIR + p], ONCE)
    for found, expected in zip(once(MANY, ROWS[3]), plain(MANY, ROWS[3]), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-15)
    few(MANY, ROWS[3])
    assert by_numpy(few) and not by_numpy(once)


# --- threads


def mixed() -> tuple[list[ca.SX], list[ca.SX]]:
    """Operations whose numpy versions treat the ends of an array by other code than its middle."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p")
    y = ca.vertcat(ca.sin(x[0] * p), ca.exp(x[1]), ca.atan2(x[2], x[0]), (1 + x[1] ** 2) ** 2.5)
    return [x, p], [y, ca.jacobian(y, x)]


def test_results_do_not_depend_on_threads_or_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    x, p = np.abs(np.random.default_rng(0).normal(size=(3 * CHUNK + 17, 3))), np.array([1.7])
    found = {}
    for threads in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
        function = BatchFunction(*mixed(), "numpy")
        found[threads] = function(x, p)
    for one, three in zip(found[1], found[3], strict=True):
        assert one.tobytes() == three.tobytes()
    for n, chunk in ((1, 1), (3, 1), (6, 7), (7, 7), (8, 7)):
        for one, few in zip(found[1], function(x[:n], p, chunk=chunk), strict=True):
            np.testing.assert_allclose(few, one[:n], rtol=1e-15, atol=1e-15)
