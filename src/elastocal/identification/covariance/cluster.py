"""Cluster-robust covariance: rows of a cluster may be correlated in any way (CR0 to CR3).

A cluster is what shares an error: the readings of one configuration share the arm's repeatability,
those of one day its temperature.  With B = QR, cluster rows Q_c, e_c and x̂ = V Qᵀy,

    cov(x̂) = V [ Σ_c Q_cᵀA_c e_c e_cᵀA_cᵀQ_c ] Vᵀ

    CR0  A_c = I                               Liang & Zeger 1986
    CR1  CR0 · G/(G − 1) · (n − 1)/(n − p)     the usual correction for G clusters
    CR2  A_c = (I − Q_cQ_cᵀ)^(−1/2)            Bell & McCaffrey 2002: unbiased where whitened rows
                                               are independent and of common variance
    CR3  A_c = (I − Q_cQ_cᵀ)^(−1)              nearly the jackknife over clusters, errs wide

The working model of CR2 and of the degrees of freedom is the identity: B and e are whitened.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import InputError, InsufficientDataError, require
from elastocal.identification.covariance.estimate import Array, Covariance
from elastocal.identification.covariance.orthogonal import orthogonal
from elastocal.identification.covariance.satterthwaite import SatterthwaiteSums

CRKind = Literal["CR0", "CR1", "CR2", "CR3"]

ALONE = 1e-9  # 1 − eigenvalue of Q_cᵀQ_c below which cluster c alone determines that direction
DEPENDS = 1e-6  # share of a parameter in such a direction above which it depends on it
ENTRIES = 2**22  # of a temporary array, 32 MB

DESCRIPTION = {
    "CR0": "uncorrected (biased low with few clusters)",
    "CR1": "corrected by G/(G − 1) · (n − 1)/(n − p)",
    "CR2": "bias-reduced, unbiased under the working model",
    "CR3": "nearly the jackknife over clusters",
}


@dataclass(frozen=True)
class Clusters:
    """Rows by cluster: `order` sorts them, cluster g has rows order[start[g] : start[g]+size[g]].

    `label` (G,) are the labels given, ascending.
    """

    label: NDArray[np.int64]
    order: NDArray[np.intp]
    start: NDArray[np.intp]
    size: NDArray[np.intp]

    def __len__(self) -> int:
        return self.label.size

    def sums(self, rows: Array) -> Array:
        """Sum over each cluster (G, ...) of an array (rows, ...)."""
        return np.asarray(np.add.reduceat(rows[self.order], self.start, axis=0))

    def blocks(self, columns: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Clusters (k,) of equal size and their rows (k, size), in blocks of bounded memory."""
        for size in np.unique(self.size):
            same = np.flatnonzero(self.size == size)
            step = max(1, ENTRIES // (columns * max(int(size), columns)))
            for first in range(0, same.size, step):
                some = same[first : first + step]
                yield some, self.order[self.start[some][:, None] + np.arange(size)]


def clusters_of(cluster: ArrayLike, rows: int) -> Clusters:
    """Clusters of the integer labels (rows,).

    Raises InputError where there is not one integer per row, InsufficientDataError for a single
    cluster.
    """
    labels = np.asarray(cluster)
    if labels.shape != (rows,) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"cluster must be {rows} integer labels, one per row of B; got shape {labels.shape}"
            f" of {labels.dtype} (repeat a label for each component of an observation)"
        )
    order = np.argsort(labels, kind="stable")
    label, start, size = np.unique(labels[order], return_index=True, return_counts=True)
    if label.size < 2:
        raise InsufficientDataError(
            "a cluster-robust covariance compares clusters, but all rows are in one;"
            " measure more configurations, or use a covariance of independent rows (HC3)"
        )
    return Clusters(label.astype(np.int64), order, start, size)


def cluster_robust(
    B: ArrayLike, e: ArrayLike, cluster: ArrayLike, kind: CRKind = "CR2"
) -> Covariance:
    """Covariance of x̂ that allows any correlation within a cluster (equations above).

    B (n, p) and e (n,) whitened, e = y − B x̂ the least-squares residual; `cluster` (n,) integer
    labels in any order.  Degrees of freedom by Satterthwaite for every kind, each for its own
    A_c (Pustejovsky & Tipton 2018); at most G, or G − 1 for CR0 and CR1, whose scores sum to zero
    over the clusters, and far fewer where few clusters matter.

    Where a cluster alone determines a direction, I − Q_cQ_cᵀ is singular: CR2 takes the
    generalised inverse square root, which leaves parameters outside that direction unbiased
    (there, Theorem 1).  A parameter that depends on it has no cluster-robust variance: its dof
    is 0 and its interval unbounded.  CR3 does not exist then: InsufficientDataError.

    Cost: n p² + G p³ operations and 32 MB of temporaries; nothing of size n² is formed.
    Raises InputError and InsufficientDataError as `orthogonal` and `clusters_of`.
    """
    require(kind in get_args(CRKind), f"kind must be one of {get_args(CRKind)}; got {kind!r}")
    factors, e = orthogonal(B, e)
    Q, V = factors.Q, factors.V
    n, p = Q.shape
    groups = clusters_of(cluster, n)
    meat, sums, alone = np.zeros((p, p)), SatterthwaiteSums(p), np.zeros(p, dtype=bool)
    for some, rows in groups.blocks(p):
        Qc = Q[rows]
        adjusted, determined = _adjusted(Qc, kind)
        if determined.any():
            if kind == "CR3":
                label = groups.label[some[np.argmax(determined)]]
                raise InsufficientDataError(
                    f"cluster {label} alone determines a combination of the parameters: leaving"
                    " it out, as CR3 does, leaves no answer; fit fewer parameters or use CR2"
                )
            alone |= _depends(Qc[determined], V)
        scores = (e[rows][:, None, :] @ adjusted)[:, 0]
        meat += scores.T @ scores
        a = adjusted @ V.T
        sums.add(np.sum(a * a, axis=1), Qc.transpose(0, 2, 1) @ a)
    if kind == "CR1":
        meat *= len(groups) / (len(groups) - 1) * (n - 1) / (n - p)
    text = f"rows correlated within {len(groups)} clusters, {DESCRIPTION[kind]}"
    if alone.any():
        text += f"; parameters {np.flatnonzero(alone).tolist()} hang on a single cluster"
    return Covariance(kind, factors.sandwich(meat), np.where(alone, 0.0, sums.dof()), text)


def _adjusted(Qc: Array, kind: CRKind) -> tuple[Array, NDArray[np.bool_]]:
    """A_cQ_c (k, size, p), and which of the k clusters determine a direction alone.

    For g(I − Q_cQ_cᵀ) Q_c = Q_c g(I − Q_cᵀQ_c) the smaller of the two is decomposed.
    """
    by_row = Qc.shape[1] < Qc.shape[2]
    gram = Qc @ Qc.transpose(0, 2, 1) if by_row else Qc.transpose(0, 2, 1) @ Qc
    values, U = np.linalg.eigh(gram)
    gap = 1 - values
    single = gap < ALONE
    determined = np.asarray(single.any(axis=1))
    if kind in ("CR0", "CR1"):
        return Qc, determined
    power = np.where(single, 1.0, gap) ** (-0.5 if kind == "CR2" else -1.0)
    A = (U * np.where(single, 0.0, power)[:, None, :]) @ U.transpose(0, 2, 1)
    return (A @ Qc if by_row else Qc @ A), determined


def _depends(Qc: Array, V: Array) -> NDArray[np.bool_]:
    """Which parameters (p,) depend on a direction that one of the clusters determines alone."""
    values, U = np.linalg.eigh(Qc.transpose(0, 2, 1) @ Qc)
    share = (V @ U) / np.linalg.norm(V, axis=1)[:, None]
    in_it = (np.abs(share) > DEPENDS) & (1 - values < ALONE)[:, None, :]
    return np.asarray(in_it.any(axis=(0, 2)))
