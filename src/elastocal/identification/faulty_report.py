"""What is wrong with the readings: single ones, a marker, a configuration, a block of lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.errors import ElastocalError
from elastocal.identification.noise import block_diagonal, inverse_factor
from elastocal.identification.robust.report import OutlierReport, outlier_report
from elastocal.identification.robust.screening import Mask
from elastocal.identification.solve import Solution
from elastocal.identification.variance.choose import NoiseFit
from elastocal.identification.variance.judge import own_noise
from elastocal.identification.weighting import linearised, weights_of


def report_faulty(
    whole: Solution, clean: Solution, noise: NoiseFit | None, good: Mask
) -> OutlierReport | None:
    """The report of the readings that are not `good` (N,), under the `noise` of the method.

    Readings are linearised at a fit that faulty ones do not bend (`clean`), B and residual whitened
    by the noise of single readings, D.  Where a configuration's readings share a deviation, what is
    looked at is D V⁻¹ e, the residual less that deviation's best prediction, and configurations are
    not tested: that they deviate is part of the noise.

    None for a table too large for B, and where the good readings do not determine the fit.
    """
    problem, columns = whole.problem, clean.fit.columns
    if problem.large:
        return None
    seen, table = problem.observations, problem.observations.table
    readings = linearised(problem.model, seen, clean.fit.x, columns)
    size = clean.sizes[columns]
    B, e = readings.B.reshape(len(seen.value), -1) * size, readings.e.ravel()
    shared = False
    if noise is None:
        weights = problem.weights
        B, e = weights.apply(B), weights.apply(e)
    else:
        own = own_noise(noise.fit, readings)[0]
        root = block_diagonal(inverse_factor(own))
        whiten = weights_of(noise, readings).whiten
        shared = bool((noise.fit.common > 0).any()) and whiten is not None
        if shared and whiten is not None:
            e = block_diagonal(own) @ (whiten.T @ (whiten @ e))
        B, e = root @ B, root @ e
    try:
        report = outlier_report(
            B, e, size=seen.size, good=good, line=table.row[seen.lead],
            marker=_labels(table.marker_names, table.marker[seen.lead]),
            configuration=None if shared else _labels(
                table.configuration_labels, table.configuration[seen.lead]
            ),
        )  # fmt: skip
    except (ElastocalError, np.linalg.LinAlgError):
        return None
    return replace(report, names=tuple(problem.model.names[c] for c in columns))


def _labels(names: tuple[str, ...], codes: np.ndarray) -> np.ndarray | None:
    """Labels (N,), None where all are the same."""
    return np.array(names)[codes] if len(np.unique(codes)) > 1 else None
