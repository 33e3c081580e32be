"""What single readings scatter by, whatever the arm does: of repeats, or of markers of one pose.

The flange takes all markers along as one rigid body.  Of k markers that are read in one visit,
3k − 6 numbers (1 of two markers) know nothing of where the arm is, and scatter by the instrument
alone; so do repeats, by the arm's repeatability besides.  Beside the stated noise they say whether
it is stated right, and the rest of the residual, whether the model lacks something.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from elastocal.identification.weighted_problem import inverse_factor
from elastocal.measurements import numbered
from elastocal.model.observations import Observations, pure_error
from elastocal.units import Array, IntArray

FEWEST = 35  # degrees of freedom, from which a scatter is known to a factor of 1.25 (95 %)
BEYOND = 0.005  # chance that so much scatter has the stated noise
REST = 0.01  # p-value below which the rest of the residual is more than single readings explain
MOST = 20_000  # readings that are looked at


@dataclass(frozen=True)
class SingleReadings:
    """Scatter of single readings in units of the stated noise: `ratio`, with `dof` degrees of
    freedom, `by` what, and the p-value `rest` of the rest of the residual being no more."""

    ratio: float
    dof: int
    by: str
    rest: float

    @property
    def above(self) -> bool:
        """Whether the noise is stated too small."""
        return self.ratio**2 * self.dof > float(special.chdtri(self.dof, BEYOND))

    @property
    def explains(self) -> bool:
        """Whether it explains a residual above the stated noise."""
        return self.above and self.rest >= REST


def single_readings(
    observed: Observations, residual: Array, stated: Array, spent: int
) -> SingleReadings | None:
    """From the `residual` (N·3,) of positions, the noise `stated` (N, 3, 3) for each, and how many
    parameters were `spent` on them; None where neither repeats nor markers tell."""
    n = len(observed.lead)
    if observed.kind != "position" or n > MOST:
        return None
    root = inverse_factor(stated)
    e = np.einsum("nij,nj->ni", root, residual.reshape(n, 3))
    table, lead = observed.table, observed.lead
    visit = numbered(observed.configuration, observed.load, table.repeat[lead])
    square, dof, by = *_of_bodies(observed, root, e, visit), "markers of one pose"
    if dof < FEWEST:
        square, dof = pure_error(observed.place, e)
        by = "repeats"
    rest = residual.size - spent - dof
    if dof < FEWEST or rest < 1 or square <= 0:
        return None
    F = max(float((e**2).sum()) - square, 0.0) / rest / (square / dof)
    return SingleReadings(
        float(np.sqrt(square / dof)), dof, by, float(special.fdtrc(rest, dof, F))
    )  # fmt: skip


def _of_bodies(observed: Observations, root: Array, e: Array, visit: IntArray) -> tuple[float, int]:
    """Sum of squares and degrees of freedom of whitened e (N, 3) off rigid motions of the markers
    of each visit, the markers' own places on the tool being fitted."""
    table, lead = observed.table, observed.lead
    p = np.asarray(table.position)[lead]
    square, dof = 0.0, 0
    order = np.argsort(visit, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(visit[order])) + 1):
        if len(rows) < 2:
            continue
        turn = np.cross(np.eye(3), (p[rows] - p[rows].mean(axis=0))[:, None, :])
        columns = np.concatenate(
            [np.broadcast_to(np.eye(3), turn.shape), turn.transpose(0, 2, 1)], axis=2
        )
        Q, size, _ = np.linalg.svd((root[rows] @ columns).reshape(-1, 6), full_matrices=False)
        Q = Q[:, size > 1e-9 * size.max()]
        own = e[rows].ravel()
        square += float(own @ own - ((Q.T @ own) ** 2).sum())
        dof += len(own) - Q.shape[1]
    markers = len(np.unique(table.marker[lead]))
    return square, dof - max(3 * markers - 6, min(markers - 1, 1))
