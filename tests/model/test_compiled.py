"""Compiled functions compute what numpy computes, to 1e-12."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.backends import system_compiler
from support.cells import kr270_cell, kr270_chain, random_table
from support.expressions import X, Y, built

from elastocal.measurements import Measurements
from elastocal.model import BatchFunction, Model
from elastocal.model.c_engine import COMPILED_CHUNK

RELATIVE = 1e-12
EFFECTS = ("joint_offset", "joint_compliance", "marker_position")
RIGID = ("base_frame", "joint_offset", "marker_position")


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory):
    """One cache for the module, so that a model is compiled once."""
    system_compiler()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ELASTOCAL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def both(inputs: list[ca.SX], outputs: list[ca.SX], *values: np.ndarray) -> list[tuple]:
    """(compiled, by numpy) of every output."""
    with np.errstate(all="ignore"):
        plain = BatchFunction(inputs, outputs, "numpy")(*values)
    return list(zip(BatchFunction(inputs, outputs, "compiled")(*values), plain, strict=True))


def assert_alike(found: np.ndarray, expected: np.ndarray) -> None:
    """NaN and infinities in the same places, numbers alike to RELATIVE of the larger of 1 and the
    largest in the same column."""
    assert found.shape == expected.shape
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    infinite = np.isinf(expected)
    np.testing.assert_array_equal(found[infinite], expected[infinite])
    difference = np.where(np.isfinite(expected), found - np.where(infinite, 0, expected), 0.0)
    size = np.abs(np.where(np.isfinite(expected), expected, 0.0)).max(axis=0, initial=1.0)
    assert (np.abs(difference) <= RELATIVE * size).all()


# --- operations ----------------------------------------------------------------------------

UNARY = {
    "neg": -X, "exp": ca.exp(X), "log": ca.log(X), "sqrt": ca.sqrt(X), "sq": X * X,
    "sin": ca.sin(X), "cos": ca.cos(X), "tan": ca.tan(X), "asin": ca.asin(X), "acos": ca.acos(X),
    "atan": ca.atan(X), "fabs": ca.fabs(X), "sign": ca.sign(X), "sinh": ca.sinh(X),
    "cosh": ca.cosh(X), "tanh": ca.tanh(X), "inv": 1 / X, "log1p": ca.log1p(X),
    "expm1": ca.expm1(X), "floor": ca.floor(X), "ceil": ca.ceil(X), "twice": 2 * X,
    "not": ca.logic_not(X), "power 3": X**3, "power 2.5": X**2.5,
}  # fmt: skip
BINARY = {
    "add": X + Y, "sub": X - Y, "mul": X * Y, "div": X / Y, "pow": X**Y,
    "atan2": ca.atan2(X, Y), "fmin": ca.fmin(X, Y), "fmax": ca.fmax(X, Y),
    "hypot": ca.hypot(X, Y), "fmod": ca.fmod(X, Y), "lt": X < Y, "le": X <= Y, "eq": X == Y,
    "ne": X != Y, "and": ca.logic_and(X, Y), "or": ca.logic_or(X, Y),
    "copysign": ca.copysign(X, Y), "if_else_zero": ca.if_else(X > Y, X, 0),
    "if_else": ca.if_else(X > Y, ca.sin(X), ca.cos(Y)),
}  # fmt: skip
SPECIAL = (-np.inf, -2.5, -1.0, -0.5, 0.0, 0.25, 1.0, 2.0, 3.25, np.inf, np.nan)


def test_every_operation_also_of_nan_and_infinity() -> None:
    points = np.array([[a, b] for a in SPECIAL for b in SPECIAL])
    outputs = [*UNARY.values(), *BINARY.values()]
    names = [*UNARY, *BINARY]
    results = both([X, Y], outputs, points[:, :1], points[:, 1:])
    for name, (found, expected) in zip(names, results, strict=True):
        try:
            assert_alike(found, expected)
        except AssertionError as error:
            raise AssertionError(f"{name}: {error}") from None


numbers = st.floats(-3, 3, allow_subnormal=False).map(lambda v: round(v, 2))
trees = st.recursive(
    st.sampled_from(["x", "y", "p"]) | numbers,
    lambda inner: (
        st.tuples(st.sampled_from(sorted(UNARY)), inner)
        | st.tuples(st.sampled_from(sorted(BINARY)), inner, inner)
    ),
    max_leaves=25,
)


def signed(operation: str, parts: list[ca.SX]) -> list[ca.SX]:
    """A NaN's sign is the library's affair."""
    return [parts[0], ca.fmax(parts[1], -1e300)] if operation == "copysign" else parts


# Several expressions to one compilation: starting the compiler takes longer than they do.
@given(forest=st.lists(trees, min_size=5, max_size=25), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_random_expressions(forest, seed: int) -> None:
    """Ill-conditioned ones amplify last digits: two replays bound what that may amount to."""
    symbols = {name: ca.SX.sym(name) for name in "xyp"}
    inputs, outputs = (
        list(symbols.values()),
        [built(tree, symbols, {**UNARY, **BINARY}, signed) for tree in forest],
    )
    rng = np.random.default_rng(seed)
    values = [rng.normal(size=(6, 1)), rng.normal(size=(6, 1)), rng.normal(size=1)]
    near = [v * (1 + 4 * np.finfo(float).eps) for v in values]
    with np.errstate(all="ignore"):
        moved = BatchFunction(inputs, outputs, "numpy")(*near)
    for (found, expected), disturbed in zip(both(inputs, outputs, *values), moved, strict=True):
        with np.errstate(all="ignore"):
            stable = np.abs(disturbed - expected) <= 1e-13 * (1 + np.abs(expected))
        stable |= ~np.isfinite(expected) & (np.isnan(expected) == np.isnan(disturbed))
        assert_alike(found[stable], expected[stable])


def test_what_numpy_lacks_is_compiled() -> None:
    from scipy.special import erf

    x = np.linspace(-2, 2, 9)[:, None]
    found = BatchFunction([X], [ca.erf(X)], "compiled")(x)[0]
    np.testing.assert_allclose(found[..., 0], erf(x), rtol=1e-12)


# --- shapes --------------------------------------------------------------------------------


def three_outputs() -> tuple[list[ca.SX], list[ca.SX]]:
    """Dense, sparse with a constant, scalar; the last input is not used."""
    q, p, unused = ca.SX.sym("q", 3), ca.SX.sym("p", 2), ca.SX.sym("unused", 4)
    dense = ca.vertcat(ca.horzcat(q[0] * p[0], ca.sin(q[1])), ca.horzcat(q[2], p[1] + 1))
    sparse = ca.SX(3, 2)
    sparse[2, 0], sparse[0, 1], sparse[1, 1] = ca.cos(q[0]), p[0], 0.1
    return [q, p, unused], [dense, sparse, ca.sumsqr(q), ca.SX(2, 0)]


@pytest.mark.parametrize("n", [
    0, 1, 7, COMPILED_CHUNK - 1, COMPILED_CHUNK, COMPILED_CHUNK + 1,
])  # fmt: skip
def test_numbers_of_rows(n: int) -> None:
    """None, one, a few, about a block."""
    rng = np.random.default_rng(n)
    values = rng.normal(size=(n, 3)), rng.normal(size=2), np.zeros((n, 4))
    for found, expected in both(*three_outputs(), *values):
        np.testing.assert_allclose(found, expected, rtol=RELATIVE)
        assert found.shape == expected.shape


def test_blocks_leave_no_trace() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(100, 3)), rng.normal(size=2), np.zeros(4)
    function = BatchFunction(*three_outputs(), "compiled")
    for whole, pieces in zip(function(*values), function(*values, chunk=7), strict=True):
        np.testing.assert_array_equal(whole, pieces)


@pytest.mark.parametrize("given_as", [
    lambda q: np.asfortranarray(q), lambda q: np.hstack([q, q])[:, :3],
    lambda q: np.repeat(q, 2, axis=0)[::2], lambda q: q[::-1][::-1], lambda q: q.astype(">f8"),
    lambda q: np.frombuffer(b"x" + q.tobytes(), dtype=np.uint8)[1:].view(float).reshape(-1, 3),
])  # fmt: skip
def test_arrays_of_any_layout(given_as) -> None:
    q = np.random.default_rng(1).normal(size=(9, 3))
    function = BatchFunction(*three_outputs(), "compiled")
    expected = function(q, np.ones(2), np.zeros(4))
    for found, exact in zip(function(given_as(q), np.ones(2), np.zeros(4)), expected, strict=True):
        np.testing.assert_array_equal(found, exact)


def test_one_row_for_all_by_broadcasting() -> None:
    q = np.random.default_rng(2).normal(size=3)
    found = BatchFunction(*three_outputs(), "compiled")(
        np.broadcast_to(q, (20, 3)), np.ones(2), np.zeros(4)
    )
    np.testing.assert_allclose(found[2][:, 0, 0], np.full(20, (q**2).sum()), rtol=1e-15)


def test_integers_are_numbers() -> None:
    found = BatchFunction([X], [X / 2], "compiled")(np.array([[3]], dtype=np.int32))[0]
    assert found.item() == 1.5


def test_expressions_without_inputs_and_functions_without_outputs() -> None:
    assert BatchFunction([X], [ca.SX([0.1, 3.0])], "compiled")(np.ones(1))[0].tolist() == [
        [[0.1], [3.0]]
    ]
    assert BatchFunction([X], [], "compiled")(np.ones(1)) == []


# --- models --------------------------------------------------------------------------------


def model(kind: str, backend: str, observe: str = "position") -> Model:
    deflection = "linear" if kind == "linear" else "equilibrium"
    effects = RIGID if kind == "explicit" else EFFECTS
    cell = kr270_cell(effects, observe, deflection_model=deflection)
    return Model.assembled(kr270_chain(), cell, backend=backend)


def table(poses: int) -> Measurements:
    return random_table(kr270_chain(), poses, poses)


@pytest.mark.parametrize("kind", ["explicit", "linear", "implicit"])
def test_models_agree_for_every_choice_of_columns(kind: str) -> None:
    compiled, plain = model(kind, "compiled"), model(kind, "numpy")
    rows, n = table(20), len(plain.parameters)
    for columns in (None, np.array([], dtype=int), np.array([n - 1, 0, 7])):
        found, expected = (m.regressor(rows, columns=columns) for m in (compiled, plain))
        assert_alike(found.B, expected.B)
        np.testing.assert_allclose(found.prediction, expected.prediction, rtol=RELATIVE)
    np.testing.assert_allclose(compiled.predict(rows), plain.predict(rows), rtol=RELATIVE)
    assert compiled.backend_report().startswith("compiled (")


@pytest.mark.parametrize("observe", ["pose", "distance"])
def test_models_agree_for_every_observation(observe: str) -> None:
    models = [model("explicit", backend, observe) for backend in ("compiled", "numpy")]
    found, expected = (m.regressor(table(5)) for m in models)
    assert_alike(found.B, expected.B)


def test_a_table_without_rows() -> None:
    found = model("linear", "compiled").predict(table(1).take(np.array([], dtype=int)))
    assert found.shape == (0,)
