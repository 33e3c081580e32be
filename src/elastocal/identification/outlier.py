"""A reading beyond the noise, and runs of such readings."""

from __future__ import annotations

from dataclasses import dataclass

FALSE_ALARM = 0.01  # chance that a clean table yields any faulty reading at all


@dataclass(frozen=True)
class Outlier:
    """A reading whose residual lies beyond what the noise explains."""

    line: int
    configuration: str
    marker: str
    residual: float
    ratio: float


def blocks(lines: list[int], gap: int = 3) -> list[tuple[int, int]]:
    """Runs of faulty lines, (first, last), bridging gaps of up to `gap` lines."""
    runs: list[tuple[int, int]] = []
    for line in sorted(lines):
        if runs and line - runs[-1][1] <= gap:
            runs[-1] = (runs[-1][0], line)
        else:
            runs.append((line, line))
    return runs
