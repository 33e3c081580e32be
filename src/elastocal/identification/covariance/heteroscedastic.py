"""Covariance from independent rows: of common variance, or each of its own (HC0 to HC4)."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from elastocal.errors import InsufficientDataError, require
from elastocal.identification.covariance.estimate import Array, Covariance
from elastocal.identification.covariance.orthogonal import orthogonal
from elastocal.identification.covariance.satterthwaite import SatterthwaiteSums

HCKind = Literal["HC0", "HC1", "HC2", "HC3", "HC4"]

ALONE = 1e-9  # 1 − leverage below which a row is fitted exactly, whatever was read there
ENTRIES = 2**22  # of a temporary array, 32 MB

DESCRIPTION = {
    "HC0": "each row its own variance, e² as it is (biased low in small samples)",
    "HC1": "each row its own variance, e² · n/(n − p)",
    "HC2": "each row its own variance, e²/(1 − h), unbiased under equal variances",
    "HC3": "each row its own variance, e²/(1 − h)², nearly the jackknife",
    "HC4": "each row its own variance, e²/(1 − h)^min(4, nh/p)",
}


def classical(B: ArrayLike, e: ArrayLike) -> Covariance:
    """s² (BᵀB)⁻¹ with s² = eᵀe/(n − p) and n − p degrees of freedom.

    B (n, p) and e (n,) whitened, e = y − B x̂ the least-squares residual.  Right where whitened
    rows are independent with a common variance: Klimchik et al. 2013, eq. (7), and (13) with
    weights known up to a factor.  Raises InputError and InsufficientDataError as `orthogonal`.
    """
    factors, e = orthogonal(B, e)
    n, p = factors.Q.shape
    matrix = factors.sandwich(np.eye(p) * float(e @ e) / (n - p))
    text = "rows independent, of common variance"
    return Covariance("classical", matrix, np.full(p, float(n - p)), text)


def hc(B: ArrayLike, e: ArrayLike, kind: HCKind = "HC3") -> Covariance:
    """Heteroscedasticity-consistent (BᵀB)⁻¹ Bᵀ diag(f_i² e_i²) B (BᵀB)⁻¹, rows independent.

    With the leverage h_i = |Q_i|², B = QR, and f_i² = 1 (HC0; White 1980), n/(n − p) (HC1),
    1/(1 − h_i) (HC2), 1/(1 − h_i)² (HC3; MacKinnon & White 1985) or (1 − h_i)^−min(4, n h_i/p)
    (HC4; Cribari-Neto 2004).  Degrees of freedom: n − p for HC0 and HC1; for the others those of
    Satterthwaite (Bell & McCaffrey 2002), as `cluster_robust` with every row a cluster.

    B (n, p) and e (n,) whitened, e = y − B x̂.  Raises InsufficientDataError where HC2 to HC4
    meet a row of leverage one: its residual is zero whatever was read, so its variance is
    unknown.  InputError as `orthogonal`, and for an unknown kind.
    """
    require(kind in get_args(HCKind), f"kind must be one of {get_args(HCKind)}; got {kind!r}")
    factors, e = orthogonal(B, e)
    Q, V = factors.Q, factors.V
    n, p = Q.shape
    h = np.einsum("ij,ij->i", Q, Q)
    adjusted = kind not in ("HC0", "HC1")
    exact = np.flatnonzero(1 - h < ALONE)
    if adjusted and exact.size:
        raise InsufficientDataError(
            f"row {exact[0]} of B alone determines a combination of the parameters (leverage"
            f" one; {exact.size} such rows), so {kind} has no residual to judge it by; measure"
            " there again, fit fewer parameters, or use HC1"
        )
    f = _factor(kind, h, p)
    scores = Q * (f * e)[:, None]
    matrix = factors.sandwich(scores.T @ scores)
    dof = _dof(Q, V, f) if adjusted else np.full(p, float(n - p))
    return Covariance(kind, matrix, dof, DESCRIPTION[kind])


def _factor(kind: HCKind, h: Array, p: int) -> Array:
    """f (n,), by which the residual is multiplied."""
    n = h.size
    if kind == "HC0":
        return np.ones(n)
    if kind == "HC1":
        return np.full(n, np.sqrt(n / (n - p)))
    power = np.minimum(4.0, n * h / p) if kind == "HC4" else 1.0 if kind == "HC2" else 2.0
    return np.asarray((1 - h) ** (-power / 2))


def _dof(Q: Array, V: Array, f: Array) -> Array:
    """Satterthwaite dof (p,): every row a cluster, a_i = f_i Q_iᵀv_j, b_i = a_i Q_i."""
    n, p = Q.shape
    sums = SatterthwaiteSums(p)
    block = max(1, ENTRIES // p**2)
    for start in range(0, n, block):
        part = slice(start, start + block)
        a = f[part, None] * (Q[part] @ V.T)
        sums.add(a**2, Q[part, :, None] * a[:, None, :])
    return sums.dof()
