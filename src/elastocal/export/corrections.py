"""Smooth functions as a table: what no format of geometry holds, for controllers of one's own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from elastocal.errors import InputError
from elastocal.identification.covariance import t_quantile
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.smooth_groups import SmoothGroup, smooth_groups
from elastocal.tables import csv_text

COLUMNS = (
    "effect", "where", "follows", "position_deg", "time_s", "component", "unit", "value", "half95",
)  # fmt: skip
LEVEL = 0.95
PER_LENGTH = 10  # rows for each correlation length
FEWEST, MOST = 21, 5001
MICRO = {"rad": "urad", "m": "um"}


def corrections_csv(calibrated: CalibratedArm, note: str) -> str:
    """Every smooth function over its range, with the half width of its 95 % band.

    A row says by how much (urad or um) the place has moved beyond its commanded or identified
    position: of a joint its angle, of a link its end frame along and about its axes (components 1
    to 6), of the base along and about the data's axes, of a marker its position in the flange
    frame.  `position_deg` or `time_s` is what it follows.  A line that begins with # says where
    the numbers come from.

    Raises InputError where the arm has no such function.
    """
    rows = [row for group in smooth_groups(calibrated.model) for row in _rows(calibrated, group)]
    if not rows:
        raise InputError(
            f"{calibrated.source}: this arm has no smooth function to be written as corrections; "
            "elastocal diagnose finds those that the readings show"
        )
    return csv_text(COLUMNS, rows, [note])


def _rows(calibrated: CalibratedArm, group: SmoothGroup) -> Iterator[tuple[str, ...]]:
    names, place = calibrated.model.names, {n: k for k, n in enumerate(calibrated.determined)}
    if group.basis is None or not any(names[c] in place for c in group.columns.ravel()):
        return
    steps = int(np.ceil((group.high - group.low) / group.length * PER_LENGTH))
    x = group.grid(min(max(steps + 1, FEWEST), MOST))
    waves = group.basis(x)
    quantile = float(t_quantile(LEVEL, np.array(np.inf)))
    for component, (columns, unit) in enumerate(zip(group.columns, group.units, strict=True)):
        value = waves @ calibrated.x[columns]
        known = np.array([names[c] in place for c in columns])
        at = [place[names[c]] for c in columns[known]]
        own = waves[:, known]
        variance = np.einsum("nk,kl,nl->n", own, calibrated.covariance[np.ix_(at, at)], own)
        half = quantile * np.sqrt(np.maximum(variance, 0.0))
        for position, moved, width in zip(x, value, half, strict=True):
            yield (
                group.effect, group.where, group.follows, *_position(group, position),
                str(component + 1), MICRO.get(unit, unit), _number(moved), _number(width),
            )  # fmt: skip


def _position(group: SmoothGroup, x: float) -> tuple[str, str]:
    return (f"{np.degrees(x):.4f}", "") if group.lasting else ("", f"{x:.1f}")


def _number(value: float) -> str:
    """In µm or µrad, to a thousandth of one."""
    return f"{value * 1e6 + 0.0:.3f}"
