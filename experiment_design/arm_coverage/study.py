"""Do intervals hold where the parameters are chosen anew, and arms scatter as arms do?

    elastocal study experiment_design/arm_coverage [--set replicates=1000]

Every scenario of campaigns.py through `identify` as it comes: geometry and compliances at a free
base, the choice of parameters, of the noise model and of faulty readings inside each campaign.  A
task is one campaign.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from campaigns import SCENARIOS, Campaign, arm
from scipy import stats

from elastocal.identification.identify import identify
from elastocal.identification.result import Calibration

LEVELS = {"held_95": 0.95, "held_9973": 0.9973}


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    chosen = [s for s in SCENARIOS if options["only"] in ("", s)]
    for number in range(options["first"], options["first"] + options["replicates"]):
        for scenario in chosen:
            yield {"scenario": scenario, "number": number, "errors": options["errors"]}


def run(task: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    """A row of study.toml's columns; the campaign's seed follows from scenario and number."""
    campaign = Campaign(task["scenario"], task["number"], task["errors"])
    model, true = arm(), campaign.true
    result = identify(model, campaign.table)
    determined = np.array([model.names.index(name) for name in result.determined])
    error, std, dof = estimates(result, true)
    held = {name: holds(error, std, dof, level) for name, level in LEVELS.items()}
    springs = np.array([name.endswith("compliance") for name in result.determined])
    row = {"estimates": len(error), "springs": int(springs.sum())}
    for name, inside in held.items():
        row |= {name: int(inside.sum()), f"springs_{name}": int(inside[springs].sum())}

    exact = campaign.test.position
    off = model.predict(campaign.test, result.x).reshape(-1, 3) - exact
    row["error"] = float(np.sqrt((off**2).sum(axis=1).mean()))
    row["error_of_oracle"] = campaign.oracle_error()
    # What is predicted from the covariance, the values of what was not determined held.
    B = model.regressor(campaign.test, result.x, determined).B
    dof, share = result.spread.tails(B[:, None, :])
    spread = np.sqrt(share * np.einsum("ij,jk,ik->i", B, result.covariance, B))
    for key, level in (("positions_held", 0.95), ("positions_held_9973", 0.9973)):
        row[key] = float(holds(off.ravel(), spread, dof, level).mean())
    # A reading at a new pose errs by the prediction and by noise of its own, of another campaign.
    noise, clean = campaign.drawn(campaign.test)
    reading = (off - noise)[clean]
    row["reading_error"] = float(np.sqrt((reading**2).sum(axis=1).mean()))
    row["held_out"] = result.heldout_rms
    row["noise"] = result.noise.kind
    for kind in ("joint_scatter", "drift"):
        row[f"told_{kind}"] = int(result.finding(kind) is not None)
    trust = result.finding("trust")
    return [row | {"trusted": int(trust is not None and trust.severity == "good")}]


def estimates(result: Calibration, true: np.ndarray) -> tuple[np.ndarray, ...]:
    """Error, standard deviation and its degrees of freedom of each determined parameter or
    combination."""
    truths = dict(zip(result.model.names, true, strict=True))
    found = []
    for name in result.determined:
        e, truth = result[name], truths[name]
        if not e.identifiable:
            e = result.combination(name)
            truth = sum(f * (truths[part] - e.held.get(part, 0.0)) for part, f in e.terms.items())
        found.append([e.value - truth, e.std, e.dof])
    return tuple(np.array(found).T)


def holds(error: np.ndarray, std: np.ndarray, dof: np.ndarray, level: float) -> np.ndarray:
    return np.asarray(np.abs(error) <= stats.t.isf((1 - level) / 2, dof) * std)


def summary(frame: pd.DataFrame) -> str:
    lines = [
        f"# Intervals of whole arms, {frame.groupby('scenario').size().max()} campaigns at most",
        "",
        "| noise | campaigns | 95 % / 99.73 % hold | compliances 95 / 99.73 % | error at new poses "
        "over the oracle's | held-out over true error of a reading at new poses | predicted "
        "position 95 / 99.73 % | joint scatter told | drift told | trusted |",
        "|" + "---|" * 10,
    ]
    for scenario, name in SCENARIOS.items():
        rows = frame[frame["scenario"] == scenario]
        if not len(rows):
            continue
        total = rows.sum(numeric_only=True)

        def share(count: str, of: str, total: pd.Series = total) -> str:
            return f"{100 * total[count] / total[of]:.2f}"

        ratio = np.sqrt((rows["error"] ** 2).mean() / (rows["error_of_oracle"] ** 2).mean())
        finite = rows[np.isfinite(rows["held_out"])]
        held = np.sqrt((finite["held_out"] ** 2).mean() / (finite["reading_error"] ** 2).mean())
        told = [
            f"{100 * rows[k].mean():.0f} %" for k in ("told_joint_scatter", "told_drift", "trusted")
        ]
        lines.append(
            f"| {name} | {len(rows)} | {share('held_95', 'estimates')} / "
            f"{share('held_9973', 'estimates')} | {share('springs_held_95', 'springs')} / "
            f"{share('springs_held_9973', 'springs')} | {ratio:.3f} | {held:.3f} | "
            f"{100 * rows['positions_held'].mean():.1f} / "
            f"{100 * rows['positions_held_9973'].mean():.2f} | {' | '.join(told)} |"
        )
    return "\n".join(lines) + "\n"
