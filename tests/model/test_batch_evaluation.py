"""Evaluation of arrays is what CasADi computes: operations, chunks, shapes, complex steps."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.expressions import X, Y, built

from elastocal.model.evaluate import CHUNK, BatchFunction

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
    """(n, rows, columns): one CasADi call per row."""
    function = ca.Function("f", inputs, [output])
    n = max(len(v) for v in values if v.ndim == 2)
    rows = [[v[i] if v.ndim == 2 else v for v in values] for i in range(n)]
    return np.array([function(*row).full() for row in rows])


def assert_evaluates(inputs: list[ca.SX], output: ca.SX, *values: np.ndarray) -> None:
    with np.errstate(all="ignore"):
        found = BatchFunction(inputs, [output], "numpy")(*values)[0]
    np.testing.assert_allclose(
        found, casadi_values(inputs, output, *values), rtol=4e-15, atol=1e-300
    )


# --- every operation -----------------------------------------------------------------------


@pytest.mark.parametrize("name", UNARY)
def test_unary_operations(name: str) -> None:
    """NaN and infinity included: log(−1), 1/0."""
    assert_evaluates([X], UNARY[name], POINTS[:, :1])


@pytest.mark.parametrize("name", BINARY)
def test_binary_operations(name: str) -> None:
    assert_evaluates([X, Y], BINARY[name], POINTS[:, :1], POINTS[:, 1:])


# --- whole expressions ---------------------------------------------------------------------

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
@settings(max_examples=150, deadline=None)
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


def three_outputs() -> tuple[list[ca.SX], list[ca.SX]]:
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 2)
    dense = ca.vertcat(ca.horzcat(q[0] * p[0], ca.sin(q[1])), ca.horzcat(q[2], p[1] + 1))
    sparse = ca.SX(3, 2)
    sparse[2, 0], sparse[0, 1] = ca.cos(q[0]), p[0]
    return [q, p], [dense, sparse, ca.sumsqr(q)]


def evaluated(q: np.ndarray, p: np.ndarray) -> list[np.ndarray]:
    """What three_outputs means, by numpy."""
    dense = np.array([[[a * p[0], np.sin(b)], [c, p[1] + 1]] for a, b, c in q])
    sparse = np.zeros((len(q), 3, 2))
    sparse[:, 2, 0], sparse[:, 0, 1] = np.cos(q[:, 0]), p[0]
    return [dense, sparse, (q**2).sum(axis=1)[:, None, None]]


# --- shapes and chunks ---------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 7, CHUNK])
@pytest.mark.parametrize("beyond", [None, -1, 0, 1])
def test_chunk_boundaries(chunk: int, beyond: int | None) -> None:
    """n = 1, one below, at and above a chunk, and a last chunk of one row."""
    n = 1 if beyond is None else max(chunk + beyond, 1)
    rng = np.random.default_rng(n)
    q, p = rng.normal(size=(n, 3)), rng.normal(size=2)
    inputs, outputs = three_outputs()
    function = BatchFunction(inputs, outputs, "numpy")
    for found, expected in zip(function(q, p, chunk=chunk), evaluated(q, p),
                               strict=True):  # fmt: skip
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("backend", ["auto", "numpy"])
@pytest.mark.parametrize("given_as", [
    lambda q: np.asfortranarray(q), lambda q: np.hstack([q, q])[:, :3],
    lambda q: np.repeat(q, 2, axis=0)[::2], lambda q: q[::-1][::-1], lambda q: q.astype(">f8"),
    lambda q: np.frombuffer(b"x" + q.tobytes(), dtype=np.uint8)[1:].view(float).reshape(-1, 3),
    lambda q: np.round(10 * q).astype(np.int32),
])  # fmt: skip
def test_arrays_of_any_layout(given_as, backend: str) -> None:
    q = given_as(np.random.default_rng(1).normal(size=(9, 3)))
    function = BatchFunction(*three_outputs(), backend)
    plain = np.array(q.tolist(), dtype=float)
    for found, exact in zip(function(q, np.ones(2)), function(plain, np.ones(2)), strict=True):
        np.testing.assert_array_equal(found, exact)


# --- complex steps -------------------------------------------------------------------------

ANALYTIC = ("neg", "exp", "log", "sqrt", "sq", "sin", "cos", "tan", "asin", "acos", "atan",
            "sinh", "cosh", "tanh", "inv", "log1p", "expm1", "twice", "identity",
            "power 3", "power 2.5")  # fmt: skip
PIECEWISE = {"fmax": ca.fmax(X, 1.0), "fmin": ca.fmin(X, 1.0), "lt": (X < 1) * X,
             "if_else_zero": ca.if_else(X > 1, X * X, 0)}  # fmt: skip


def assert_complex_step(expression: ca.SX, at: np.ndarray) -> None:
    step = 1e-30
    found = BatchFunction([X], [expression], "numpy")(at + 1j * step)[0]
    np.testing.assert_allclose(found.real, casadi_values([X], expression, at), rtol=4e-15)
    slope = casadi_values([X], ca.jacobian(expression, X), at)
    np.testing.assert_allclose(found.imag / step, slope, rtol=4e-14)  # 1 − tanh² cancels


@pytest.mark.parametrize("name", [*ANALYTIC, *PIECEWISE])
def test_complex_step_is_the_derivative(name: str) -> None:
    expression = UNARY[name] if name in ANALYTIC else PIECEWISE[name]
    assert_complex_step(expression, np.array([[0.3], [0.9], [1.7], [3.1]]))
