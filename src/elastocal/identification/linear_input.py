"""Check of the arrays that enter a weighted linear least-squares problem."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from elastocal.errors import InputError
from elastocal.identification.exact_products import Array


def checked_problem(
    B: ArrayLike, y: ArrayLike, weights: ArrayLike | None, scale: ArrayLike | None
) -> tuple[Array, Array, Array, Array | None]:
    """All four as finite float arrays of matching shapes, or an InputError that names one."""
    B = _finite("B", B)
    if B.ndim != 2 or 0 in B.shape:
        raise InputError(f"B must have shape (rows, parameters), none zero; got {B.shape}")
    m, p = B.shape
    y = _finite("y", y)
    if y.shape != (m,):
        raise InputError(f"y must have shape ({m},), as B has {m} rows; got {y.shape}")
    weights = np.ones(m) if weights is None else _positive("weights", weights, m, "rows")
    return B, y, weights, None if scale is None else _positive("scale", scale, p, "columns")


def _positive(name: str, values: ArrayLike, size: int, like: str) -> Array:
    array = _finite(name, values)
    if array.shape != (size,):
        shape = f"({size},), as B has {size} {like}"
        raise InputError(f"{name} must have shape {shape}; got {array.shape}")
    bad = np.flatnonzero(array <= 0)
    if bad.size:
        raise InputError(f"{name} must be positive; {name}[{bad[0]}] is {array[bad[0]]}")
    return array


def _finite(name: str, values: ArrayLike) -> Array:
    try:
        if np.iscomplexobj(values):
            raise TypeError("found complex ones")
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of real numbers: {error}") from None
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        at = tuple(int(i) for i in bad[0])
        raise InputError(f"{name} must be finite; {name}{list(at)} is {array[at]}")
    return array
