"""Cluster-robust covariance of a fit to a table too large for its B to be formed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.chunked import in_order, regressor
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.fit import Fit
from elastocal.identification.partition import Partition, Span

Array = NDArray[np.float64]

# Configurations per parameter from which the sandwich needs no correction for leverage: its bias
# and the loss of degrees of freedom are then a few per cent.
ENOUGH = 10


def worth_clustering(parts: Partition, n_parameters: int) -> bool:
    """Whether configurations hold several readings, and are enough for their scatter to count."""
    configurations = len(np.unique(parts.seen.configuration))
    return len(parts.seen.lead) > configurations >= ENOUGH * n_parameters


def cluster_by_parts(fit: Fit, parts: Partition) -> Covariance:
    """CR1 over configurations (Liang and Zeger 1986), in passes over the parts of the table.

    C Σ_c (B_cᵀe_c)(B_cᵀe_c)ᵀ C · G/(G − 1) · (n − 1)/(n − p) with C = (BᵀB)⁻¹, whitened, G
    configurations and n rows; t with G − 1 degrees of freedom.
    """
    model, size = fit.problem.model, fit.problem.sizes[fit.columns]
    p = len(size)

    def scores(span: Span) -> dict[int, Array]:
        part = parts.part(span)
        at = regressor(model, part, fit.x, fit.columns)
        B, e = part.weights.apply(at.B * size), part.weights.apply(at.residual)
        rows_of = np.repeat(part.observations.configuration, part.observations.size)
        codes, where = np.unique(rows_of, return_inverse=True)
        order = np.argsort(where, kind="stable")
        starts = np.searchsorted(where[order], np.arange(len(codes)))
        sums = np.add.reduceat((B * e[:, None])[order], starts, axis=0)
        return dict(zip(codes.tolist(), sums, strict=True))

    def meat(spans: tuple[Span, ...]) -> Array:
        total: dict[int, Array] = {}
        for span in spans:
            for code, score in scores(span).items():
                total[code] = total.get(code, np.zeros(p)) + score
        S = np.array(list(total.values()))
        return np.asarray(S.T @ S)

    middle = np.zeros((p, p))
    for part in in_order(parts.groups, meat):
        middle += part
    n, G = len(parts.seen.value), len(np.unique(parts.seen.configuration))
    factor = G / (G - 1) * (n - 1) / (n - p)
    cofactor = fit.cofactor() / np.outer(size, size)
    matrix = factor * cofactor @ middle @ cofactor * np.outer(size, size)
    text = f"readings of a configuration may depend on each other ({G} configurations)"
    return Covariance("CR1", matrix, np.full(p, float(G - 1)), text)
