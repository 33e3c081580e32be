"""Measurements already done: what they tell, so that a plan adds what they lack."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from elastocal.design.readings import marker_sigmas
from elastocal.errors import InsufficientDataError
from elastocal.identification.identify import identify
from elastocal.identification.noise import Weights, weights_for, whitener
from elastocal.identification.options import Options
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations, observe
from elastocal.measurements import Measurements

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Done:
    """`x` (parameters,) the arm as identified so far, `information` (parameters, parameters) in
    the parameters' units, `numbers` observed, `note` on where x comes from."""

    x: Array
    information: Array
    numbers: int
    note: str


def measured(model: Model, table: Measurements, fixed: tuple[str, ...]) -> Done:
    """Information BᵀΣ⁻¹B of a table of measurements, at the parameters it identifies.

    Where it does not suffice to identify the arm, B is taken at the nominal one.  The noise is
    the stated one, as for the poses to come.
    """
    if table.sigma is None:
        table = marker_sigmas(model.cell, table)
    try:
        x = identify(model, table, Options(method="wls", fixed=fixed)).x
        note = "the arm as identified from the measurements done"
    except InsufficientDataError as error:
        x, note = model.nominal, f"the nominal arm, as the measurements do not suffice ({error})"
    seen = observe(table, model.observe)
    weights = _weights(model, seen)
    B = weights.apply(model.regressor(table, x, None, seen).B)
    return Done(x, B.T @ B, len(B), note)


def next_number(table: Measurements | None) -> int:
    """The number after those of the table's configurations, so that what is measured next can
    join it: 9 after "8", "8-" and "warm-up"; 1 where there is no table or no number."""
    labels = () if table is None else table.configuration_labels
    numbers = [int(m[0]) for m in (re.match(r"[0-9]+", label) for label in labels) if m]
    return max(numbers, default=0) + 1


def _weights(model: Model, seen: Observations) -> Weights:
    """The stated noise, and with it what readings of one visit share."""
    stated = weights_for(seen, model.cell.tracker)
    tau = model.cell.design.repeatability
    if tau == 0 or stated.whiten is None:
        return stated
    inverse = sparse.linalg.inv(sparse.csc_array(stated.whiten))
    key = np.column_stack([seen.configuration, np.round(seen.table.force[seen.lead], 6)])
    visit = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    same = sparse.csr_array((np.ones(len(visit)), (np.arange(len(visit)), visit)))
    moved = sparse.dia_array(
        (np.where(np.arange(seen.size) < 3, 1.0, 0.0)[None], [0]), shape=(seen.size, seen.size)
    )
    covariance = inverse @ inverse.T + tau**2 * sparse.kron(same @ same.T, moved)
    return Weights(stated.kind, whitener(sparse.csr_array(covariance)), True, stated.description)
