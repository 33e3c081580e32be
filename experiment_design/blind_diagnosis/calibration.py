"""Whether stated probabilities hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from records import Record
from score import named
from suites import WHOLE_SUITES

BINS = 10
Points = list[tuple[float, float, int]]


def answerable(every: Mapping[str, Sequence[Record]]) -> list[Record]:
    """The worlds whose effects the catalogue has, or which have none."""
    apart = ("outside", "left_out", *WHOLE_SUITES)
    return [r for suite, f in every.items() if suite not in apart for r in f]


def all_named(found: Sequence[Record]) -> tuple[np.ndarray, np.ndarray]:
    """Probability (n,) of every effect named in these worlds, and whether it is there (n,)."""
    each = [pair for r in found for pair in named(r["truth"], r["answer"])]
    return np.array([p for p, _ in each]), np.array([right for _, right in each], dtype=bool)


def reliability(found: Sequence[Record]) -> Points:
    """(mean probability, share right, number) of the effects named, in ten equal bins."""
    p, right = all_named(found)
    at = np.minimum((p * BINS).astype(int), BINS - 1)
    return [
        (float(p[at == k].mean()), float(right[at == k].mean()), int((at == k).sum()))
        for k in range(BINS)
        if np.any(at == k)
    ]


def calibration_error(points: Points) -> float:
    """Expected calibration error: mean of |probability − share right| over all named effects."""
    total = sum(n for _, _, n in points)
    return sum(n * abs(p - right) for p, right, n in points) / total


def draw_reliability(points: Points, path: Path) -> None:
    """Share right against stated probability, the area of a dot as the number behind it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.2, 4.0), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    if points:
        p, right, n = (np.array(column) for column in zip(*points, strict=True))
        axes.scatter(p, right, s=200 * n / n.max() + 8)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="stated probability", ylabel="share right")
    figure.savefig(path, dpi=120)
    plt.close(figure)
