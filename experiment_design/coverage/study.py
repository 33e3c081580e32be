"""Do the intervals hold, and what does not knowing the noise cost?

    elastocal study experiment_design/coverage [--set replicates=200]

Every scenario of scenarios.py, estimated by elastocal's default, by an oracle that knows the
noise, by the paper's methods, by a robust fit and by OLS with a cluster-robust covariance.  A
task is 50 campaigns of one scenario.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scenarios import SCENARIOS, Setting, setting
from tables import report, totals

from elastocal.identification.covariance import cluster_robust
from elastocal.identification.noise_judge import outlier_screening, settle
from elastocal.identification.published import eq14, ols
from elastocal.identification.robust import asymptotic_covariance, design, tukey

CHUNK = 50
PUBLISHED_EVERY = 10  # thirty iterations of a weighted fit each: a tenth of the replicates do
METHODS = (
    "default", "oracle", "OLS, CR2", "OLS, eq. (8)", "eq. (14) by group",
    "eq. (14) per residual", "Tukey MM",
)  # fmt: skip


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for first in range(0, options["replicates"], CHUNK):
        for scenario in SCENARIOS:
            campaigns = min(CHUNK, options["replicates"] - first)
            yield {"scenario": scenario.key, "first": first, "campaigns": campaigns}


def run(task: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Totals over the campaigns, by method and parameter.  A campaign's seed follows from its
    scenario and number, as it did before this study had others: `rng` is not used."""
    scenario = next(s for s in SCENARIOS if s.key == task["scenario"])
    s, numbers = setting(scenario), range(task["first"], task["first"] + task["campaigns"])
    found = np.array([estimates(s, replicate) for replicate in numbers])
    return totals(found, METHODS, s.names)


def summary(frame: pd.DataFrame) -> str:
    return report(frame, METHODS)


def estimates(s: Setting, replicate: int) -> np.ndarray:
    """(method, parameter, (error, std, dof)); NaN where a method was not run."""
    e, clean = s.draw(replicate)
    B, p = s.B, s.B.shape[1]
    found = np.full((len(METHODS), p, 3), np.nan)

    def put(method: str, x: np.ndarray, std: np.ndarray, dof: np.ndarray | float) -> None:
        found[METHODS.index(method)] = np.column_stack([x, std, np.broadcast_to(dof, p)])

    robust = tukey(design(B, e, 3))
    own = asymptotic_covariance(robust)
    put("Tukey MM", robust.x, own.std, own.dof)
    readings = s.readings(e)
    noise = settle(readings, good=outlier_screening(readings, robust.residual.reshape(-1, 3))).noise
    put("default", noise.x, noise.covariance.std, noise.covariance.dof)
    x, std = s.oracle(e, clean)
    put("oracle", x, std, np.inf)
    plain = ols(B, e)
    clustered = cluster_robust(B, plain.residual, np.repeat(s.configuration, 3))
    put("OLS, CR2", plain.x, clustered.std, clustered.dof)
    if replicate % PUBLISHED_EVERY == 0:
        group, last = eq14(B, e, s.group), eq14(B, e)[-1]
        put("OLS, eq. (8)", group[0].x, group[0].std, np.inf)
        put("eq. (14) by group", group[-1].x, group[-1].std, np.inf)
        put("eq. (14) per residual", last.x, last.std, np.inf)
    return found
