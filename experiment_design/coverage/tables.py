"""Coverage and efficiency of the methods: totals of a chunk of campaigns, and tables of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scenarios import SCENARIOS
from scipy import stats

LEVELS = {"held_95": 0.95, "held_9973": 0.9973}


def totals(
    found: np.ndarray, methods: Sequence[str], parameters: Sequence[str]
) -> list[dict[str, Any]]:
    """Rows of study.toml's columns from (campaign, method, parameter, (error, std, dof)).

    A campaign that a method was not run on holds NaN there.
    """
    rows = []
    for m, method in enumerate(methods):
        run = ~np.isnan(found[:, m]).any(axis=(1, 2))
        own, oracle = found[run, m], found[run, list(methods).index("oracle")]
        held = {name: holds(own, level).sum(axis=0) for name, level in LEVELS.items()}
        squares, best = ((part[..., 0] ** 2).sum(axis=0) for part in (own, oracle))
        rows += [
            {"method": method, "parameter": name, "run": int(run.sum())}
            | {key: int(count[j]) for key, count in held.items()}
            | {"squares": float(squares[j]), "squares_of_oracle": float(best[j])}
            for j, name in enumerate(parameters)
        ]
    return rows


def holds(result: np.ndarray, level: float) -> np.ndarray:
    """Whether intervals hold zero error (campaign, parameter); (campaign, parameter, 3) in."""
    error, std, dof = (result[..., k] for k in range(3))
    quantile = np.where(np.isinf(dof), stats.norm.isf((1 - level) / 2), 0.0)
    finite = np.isfinite(dof)
    quantile[finite] = stats.t.isf((1 - level) / 2, dof[finite])
    return np.asarray(np.abs(error) <= quantile * std)


def report(frame: pd.DataFrame, methods: Sequence[str]) -> str:
    """All tables, from the rows of every task."""
    added = frame.groupby(["scenario", "method", "parameter"], sort=False).sum(numeric_only=True)
    n = int(added["run"].max())
    sections = [f"# Coverage and efficiency, {n} campaigns per scenario"]
    for name, level in LEVELS.items():
        sections.append(
            f"## Intervals at {100 * level:g} % that hold the truth, in percent\n\n"
            + _table(added, methods, lambda rows, name=name: _held(rows, name))
        )
    sections.append(
        "## Root mean square error over that of the oracle, all parameters (the worst one)\n\n"
        + _table(added, methods, _over_oracle)
    )
    return "\n\n".join(sections) + "\n"


def _held(rows: pd.DataFrame, name: str) -> str:
    return f"{100 * (rows[name] / rows['run']).mean():.2f}"


def _over_oracle(rows: pd.DataFrame) -> str:
    ratio = rows["squares"] / rows["squares_of_oracle"]
    return f"{np.sqrt(ratio.mean()):.3f} ({np.sqrt(ratio.max()):.3f})"


def _table(added: pd.DataFrame, methods: Sequence[str], cell: Any) -> str:
    lines = ["| scenario | " + " | ".join(methods) + " |", "|" + "---|" * (len(methods) + 1)]
    for scenario in SCENARIOS:
        cells = [cell(added.loc[scenario.key, method]) for method in methods]
        lines.append(f"| {scenario.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
