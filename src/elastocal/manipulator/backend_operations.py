"""CasADi's scalar operations as numpy functions of arrays, real or complex."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np


def _twice(x: Any, out: Any = None) -> Any:
    return np.multiply(x, 2.0, out=out)


def _if_else_zero(condition: Any, value: Any, out: Any = None) -> Any:
    # np.where and not a product: the branch not taken may be infinite or NaN.
    chosen = np.where(np.not_equal(condition, 0), value, 0.0)
    if out is None:
        return chosen[()]
    out[:] = chosen
    return out


def _abs(x: Any, out: Any = None) -> Any:
    # On complex numbers the analytic continuation, so that complex steps stay derivatives.
    if np.iscomplexobj(x):
        return np.multiply(x, np.where(np.real(x) < 0, -1.0, 1.0), out=out)
    return np.abs(x, out=out)


def _sign(x: Any, out: Any = None) -> Any:
    return np.multiply(np.sign(np.real(x)), 1.0, out=out)


def _not(x: Any, out: Any = None) -> Any:
    return np.multiply(np.logical_not(x), 1.0, out=out)


def _as_number(compare: Callable) -> Callable:
    def replay(a: Any, b: Any, out: Any = None) -> Any:
        return np.multiply(compare(a, b), 1.0, out=out)

    return replay


UNARY: dict[int, Any] = {
    ca.OP_NEG: np.negative, ca.OP_EXP: np.exp, ca.OP_LOG: np.log, ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square, ca.OP_SIN: np.sin, ca.OP_COS: np.cos, ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin, ca.OP_ACOS: np.arccos, ca.OP_ATAN: np.arctan, ca.OP_FABS: _abs,
    ca.OP_SIGN: _sign, ca.OP_SINH: np.sinh, ca.OP_COSH: np.cosh, ca.OP_TANH: np.tanh,
    ca.OP_INV: np.reciprocal, ca.OP_LOG1P: np.log1p, ca.OP_EXPM1: np.expm1,
    ca.OP_FLOOR: np.floor, ca.OP_CEIL: np.ceil, ca.OP_ASSIGN: np.positive,
    ca.OP_TWICE: _twice, ca.OP_NOT: _not,
}  # fmt: skip
BINARY: dict[int, Any] = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide,
    ca.OP_POW: np.power, ca.OP_CONSTPOW: np.power, ca.OP_ATAN2: np.arctan2,
    ca.OP_FMIN: np.fmin, ca.OP_FMAX: np.fmax, ca.OP_HYPOT: np.hypot, ca.OP_FMOD: np.fmod,
    ca.OP_LT: _as_number(np.less), ca.OP_LE: _as_number(np.less_equal),
    ca.OP_EQ: _as_number(np.equal), ca.OP_NE: _as_number(np.not_equal),
    ca.OP_AND: _as_number(np.logical_and), ca.OP_OR: _as_number(np.logical_or),
    ca.OP_IF_ELSE_ZERO: _if_else_zero, ca.OP_COPYSIGN: np.copysign,
}  # fmt: skip
# The same on single numbers, where Python's operators take a tenth of the time of a numpy function.
# Not division: Python refuses to divide by zero.
ON_NUMBERS: dict[Any, Any] = {
    np.negative: operator.neg, np.add: operator.add, np.subtract: operator.sub,
    np.multiply: operator.mul,
}  # fmt: skip
