"""Coverage and efficiency of the methods as tables."""

from __future__ import annotations

import numpy as np
from scenarios import Scenario
from scipy import stats

LEVELS = 0.95, 0.9973


def report(results: dict[Scenario, np.ndarray], methods: tuple[str, ...]) -> str:
    """All tables; `results` holds (replicate, method, parameter, (error, std, dof))."""
    n = len(next(iter(results.values())))
    sections = [f"# Coverage and efficiency, {n} campaigns per scenario"]
    for level in LEVELS:
        sections.append(
            f"## Intervals at {100 * level:g} % that hold the truth, in percent\n\n"
            + _table(results, methods, lambda r, level=level: _held(r, level))
        )
    sections.append(
        "## Root mean square error over that of the oracle, all parameters (the worst one)\n\n"
        + _table(results, methods, lambda r, **_: "", relative=True)
    )
    return "\n\n".join(sections) + "\n"


def coverage(result: np.ndarray, level: float) -> np.ndarray:
    """Share (parameters,) of intervals that hold zero error; (replicate, parameter, 3) in."""
    error, std, dof = (result[..., k] for k in range(3))
    quantile = np.where(np.isinf(dof), stats.norm.isf((1 - level) / 2), 0.0)
    finite = np.isfinite(dof)
    quantile[finite] = stats.t.isf((1 - level) / 2, dof[finite])
    return (np.abs(error) <= quantile * std).mean(axis=0)


def efficiency(result: np.ndarray, oracle: np.ndarray) -> tuple[float, float]:
    """Rms error over the oracle's on the same campaigns: over all parameters, and the worst."""
    ratio = (result[..., 0] ** 2).mean(axis=0) / (oracle[..., 0] ** 2).mean(axis=0)
    return float(np.sqrt(ratio.mean())), float(np.sqrt(ratio.max()))


def _held(result: np.ndarray, level: float) -> str:
    return f"{100 * coverage(result, level).mean():.2f}"


def _table(results, methods, cell, relative=False) -> str:
    lines = ["| scenario | " + " | ".join(methods) + " |", "|" + "---|" * (len(methods) + 1)]
    for scenario, result in results.items():
        cells = []
        for m in range(len(methods)):
            run = ~np.isnan(result[:, m]).any(axis=(1, 2))
            if relative:
                whole, worst = efficiency(result[run, m], result[run, methods.index("oracle")])
                cells.append(f"{whole:.3f} ({worst:.3f})")
            else:
                cells.append(cell(result[run, m]))
        lines.append(f"| {scenario.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
