"""What the identification knows of where the tool will be, and what it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.compensation.tool import CalibratedTool
from elastocal.manipulator.calibrated import CalibratedArm
from elastocal.manipulator.chain import Array
from elastocal.manipulator.limits import finite_ranges, joint_limits

OUTSIDE = 1e-6  # share of the tool's motion that may lie outside what is known: rounding
SPARE = 4  # readings for every parameter, at random poses


@dataclass(frozen=True)
class Uncertainty:
    """`covariance` (n, 3, 3) m² of the position in the data's frame.

    `unknown` (n,) m: what typical deviations of the parameters that the data do not determine
    would move the tool by, which the covariance does not hold; `blamed` names those parameters,
    the most harmful first.
    """

    covariance: Array
    unknown: Array
    blamed: tuple[str, ...]

    @property
    def std(self) -> Array:
        """(n,) m: root of the sum of the variances along the three axes."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))


@dataclass(frozen=True)
class Undetermined:
    """The parameters D that the data left open, and what the determined ones K do in their place.

    `mixing` (K, D) with ∂(markers)/∂X_D ≈ ∂(markers)/∂X_K · mixing at any pose: a deviation of
    X_D went into the estimates of X_K as mixing · X_D.  `sizes` (D,): typical deviations.
    """

    kept: NDArray[np.int64]
    open: NDArray[np.int64]
    mixing: Array
    sizes: Array


def undetermined(tool: CalibratedTool, rows: list[NDArray], seed: int) -> Undetermined:
    """By least squares on the markers' places at random poses, in the targets' circumstances.

    What the identification left out as indistinguishable leaves no residual there; what it left
    out although it moves markers by itself does, and is then unknown at the targets as well.
    """
    arm = tool.calibrated
    names = {name: i for i, name in enumerate(arm.model.names)}
    kept = np.array([names[name] for name in arm.determined], dtype=np.int64)
    left = np.setdiff1d(np.arange(len(names)), kept)
    sizes = _sizes(arm, kept)
    if not len(left) or not len(kept):
        return Undetermined(kept, left, np.zeros((len(kept), len(left))), sizes[left])
    low, high = finite_ranges(tool.chain, *joint_limits(tool.cell, tool.chain))
    n = max(SPARE * len(names) // 3, 1)
    q = np.random.default_rng(seed).uniform(low, high, (n, tool.chain.n_joints))
    some = [values[np.arange(n) % len(values)] for values in rows]
    B = tool.marker_sensitivity(some, q)
    B = B[np.isfinite(B).all(axis=(1, 2))].reshape(-1, len(names)) * sizes
    mixing = np.asarray(np.linalg.lstsq(B[:, kept], B[:, left], rcond=1e-10)[0], dtype=float)
    known = sizes[left] > 0
    mixing[:, known] *= sizes[kept][:, None] / sizes[left][known]
    return Undetermined(kept, left, mixing, sizes[left])


def _sizes(arm: CalibratedArm, kept: NDArray[np.int64]) -> Array:
    """Typical deviation (parameters,) of each parameter; where none is known beforehand, the
    smallest value that was determined of its kind (the stiffest joint's compliance)."""
    parameters = arm.model.parameters
    found: dict[tuple[str, str], float] = {}
    for k in kept:
        p, size = parameters[k], abs(float(arm.x[k]))
        if size > 0:
            found[p.effect, p.unit] = min(size, found.get((p.effect, p.unit), np.inf))
    return np.array(
        [
            p.typical or abs(p.nominal) or found.get((p.effect, p.unit), 1.0 if k in kept else 0.0)
            for k, p in enumerate(parameters)
        ]
    )


def position_uncertainty(arm: CalibratedArm, A: Array, left: Undetermined) -> Uncertainty:
    """Σ_p = A_K Σ A_Kᵀ for A (n, 3, parameters) in m per unit, Σ of the determined parameters K.

    NaN where the result determined nothing.  A typical deviation of an open parameter moves the
    tool in an unknown way by A_D − A_K · mixing, which vanishes where the tool's point moves as
    the measured ones do.
    """
    known = A[..., left.kept]
    covariance = known @ arm.covariance @ known.transpose(0, 2, 1)
    if not len(left.kept):  # nothing known is no certainty
        covariance = np.full((len(A), 3, 3), np.nan)
    move = A[..., left.open] * left.sizes
    off = move - known @ (left.mixing * left.sizes)
    off[np.abs(off) <= OUTSIDE * np.abs(move).max(initial=0.0)] = 0.0
    harm = np.sqrt((off**2).sum(axis=1).mean(axis=0)) if len(A) else np.zeros(len(left.open))
    order = [int(i) for i in np.argsort(-harm) if harm[i] > 0]
    return Uncertainty(
        (covariance + covariance.transpose(0, 2, 1)) / 2,
        np.sqrt((off**2).sum(axis=(1, 2))),
        tuple(arm.model.names[left.open[i]] for i in order),
    )
