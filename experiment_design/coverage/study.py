"""Do the intervals hold, and what does not knowing the noise cost?

    elastocal study experiment_design/coverage [--set replicates=200]

Every scenario of scenarios.py, estimated by elastocal's default, by an oracle that knows the
noise, by the paper's methods and by OLS with a cluster-robust covariance.  A task is 50 campaigns
of one scenario.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd
from scenarios import SCENARIOS, Setting, setting
from scipy import stats

from elastocal.identification.least_squares import clustered, orthogonal
from elastocal.identification.outliers import majority, settle
from elastocal.identification.published import eq14, ols

CHUNK = 50
PUBLISHED_EVERY = 10  # thirty iterations of a weighted fit each: a tenth of the replicates do
METHODS = (
    "default", "oracle", "OLS, CR2", "OLS, eq. (8)", "eq. (14) by group", "eq. (14) per residual",
)  # fmt: skip
LEVELS = {"held_95": 0.95, "held_9973": 0.9973}


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for first in range(0, options["replicates"], CHUNK):
        for scenario in SCENARIOS:
            campaigns = min(CHUNK, options["replicates"] - first)
            yield {"scenario": scenario.key, "first": first, "campaigns": campaigns}


def run(task: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Totals over the campaigns, by method and parameter.  A campaign's seed follows from its
    scenario and number: `rng` is not used."""
    scenario = next(s for s in SCENARIOS if s.key == task["scenario"])
    s, numbers = setting(scenario), range(task["first"], task["first"] + task["campaigns"])
    found = np.array([estimates(s, replicate) for replicate in numbers])
    rows = []
    for m, method in enumerate(METHODS):
        ran = ~np.isnan(found[:, m]).any(axis=(1, 2))
        error, std, dof = np.moveaxis(found[ran, m], -1, 0)
        best = (found[ran, METHODS.index("oracle"), :, 0] ** 2).sum(axis=0)
        held = {
            name: (np.abs(error) <= stats.t.isf((1 - level) / 2, dof) * std).sum(axis=0)
            for name, level in LEVELS.items()
        }
        rows += [
            {"method": method, "parameter": name, "run": int(ran.sum())}
            | {key: int(count[j]) for key, count in held.items()}
            | {"squares": float((error[:, j] ** 2).sum()), "squares_of_oracle": float(best[j])}
            for j, name in enumerate(s.names)
        ]
    return rows


def estimates(s: Setting, replicate: int) -> np.ndarray:
    """(method, parameter, (error, std, dof)); NaN where a method was not run."""
    e, clean = s.draw(replicate)
    B, p = s.B, s.B.shape[1]
    found = np.full((len(METHODS), p, 3), np.nan)

    def put(method: str, x: np.ndarray, std: np.ndarray, dof: np.ndarray | float) -> None:
        found[METHODS.index(method)] = np.column_stack([x, std, np.broadcast_to(dof, p)])

    readings = s.readings(e)
    noise = settle(readings, good=majority(readings.B, readings.e)[0])[0]
    put("default", noise.x, noise.covariance.std, noise.covariance.dof)
    put("oracle", *s.oracle(e, clean), np.inf)
    plain = ols(B, e)
    Q, V = orthogonal(B)
    cr2 = clustered([(Q, plain.residual, np.repeat(s.configuration, 3))], V, "CR2")
    put("OLS, CR2", plain.x, cr2.std, cr2.dof)
    if replicate % PUBLISHED_EVERY == 0:
        group, last = eq14(B, e, s.group), eq14(B, e)[-1]
        put("OLS, eq. (8)", group[0].x, group[0].std, np.inf)
        put("eq. (14) by group", group[-1].x, group[-1].std, np.inf)
        put("eq. (14) per residual", last.x, last.std, np.inf)
    return found


def summary(frame: pd.DataFrame) -> str:
    """All tables, from the rows of every task."""
    added = frame.groupby(["scenario", "method", "parameter"], sort=False).sum(numeric_only=True)
    sections = [f"# Coverage and efficiency, {int(added['run'].max())} campaigns per scenario"]

    def table(title: str, cell: Callable[[pd.DataFrame], str]) -> None:
        lines = ["| scenario | " + " | ".join(METHODS) + " |", "|" + "---|" * (len(METHODS) + 1)]
        for scenario in SCENARIOS:
            cells = [cell(added.loc[scenario.key, method]) for method in METHODS]
            lines.append(f"| {scenario.name} | " + " | ".join(cells) + " |")
        sections.append(f"## {title}\n\n" + "\n".join(lines))

    def over_oracle(rows: pd.DataFrame) -> str:
        ratio = rows["squares"] / rows["squares_of_oracle"]
        return f"{np.sqrt(ratio.mean()):.3f} ({np.sqrt(ratio.max()):.3f})"

    for name, level in LEVELS.items():
        table(
            f"Intervals at {100 * level:g} % that hold the truth, in percent",
            lambda rows, name=name: f"{100 * (rows[name] / rows['run']).mean():.2f}",
        )
    table("Root mean square error over that of the oracle, all parameters (the worst one)",
          over_oracle)  # fmt: skip
    return "\n\n".join(sections) + "\n"
