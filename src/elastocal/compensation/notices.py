"""Sentences about commands that are right but that somebody should look at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.compensation.targets import Targets
from elastocal.compensation.uncertainty import Uncertainty
from elastocal.errors import option
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.effects import effect_of
from elastocal.text import listed

AT_LIMIT = 1e-9  # rad or m
FAR = 0.05  # m: a nominal command this far from its target belongs to another frame or tool
LARGE = np.radians(2.0)
LEVEL_SLACK = 0.01  # rad or m
WORTH_TELLING = 10e-6  # m


def notices_of(
    cell: Cell,
    chain: Chain,
    targets: Targets,
    limits: tuple[Array, Array],
    q: Array,
    nominal: Array,
    before: Array,
    reached: NDArray[np.bool_],
    jumps: NDArray[np.int64],
    uncertainty: Uncertainty,
) -> tuple[str, ...]:
    """What the rows that are reached give reason to say; each sentence names rows and remedy."""
    told = []
    lower, upper = limits
    held = ((q <= lower + AT_LIMIT) | (q >= upper - AT_LIMIT)) & reached[:, None]
    for limited in np.flatnonzero(held.any(axis=0)):
        told.append(
            f"{_rows(targets, held[:, limited])}: joint {limited + 1} stands at its limit; the "
            "target is reached by the other joints"
        )
    if len(jumps):
        i = int(jumps[0])
        j = int(np.abs(q[i] - q[i - 1]).argmax())
        revolute = chain.kinds[j] == "revolute"
        size = np.abs(q[i, j] - q[i - 1, j])
        by = f"{np.degrees(size):.0f}°" if revolute else f"{size * 1e3:.0f} mm"
        told.append(
            f"{_rows(targets, jumps)}: the solution branch changes (joint {j + 1} moves by {by} to "
            f"line {targets.table.row[i]}, much more than the tool's motion asks for); where the "
            "rows are a path, move it away from limits and singular postures, or give q1_deg … of "
            "the posture wanted"
        )
    change = np.where([kind == "revolute" for kind in chain.kinds], np.abs(q - nominal), 0.0)
    large = reached & (change.max(axis=1) > LARGE)
    if large.any():
        told.append(
            f"{_rows(targets, large)}: a joint is corrected by up to "
            f"{np.degrees(change[large].max()):.1f}°, as beside a singular posture; check that the "
            "path may be moved there"
        )
    if targets.q is not None and targets.position is not None:
        far = before > FAR
        if far.any():
            told.append(
                f"{_rows(targets, far)}: the nominal command q1_deg … puts the tool up to "
                f"{before[far].max() * 1e3:.0f} mm from its target; check {option('frame')}, "
                f"{option('point')} and units"
            )
    told += _without_load(cell, targets)
    told += _beyond_levels(cell, targets, q, reached)
    unknown = uncertainty.unknown[reached]
    rms = float(np.sqrt(np.mean(unknown**2))) if len(unknown) else 0.0
    stated = float(np.sqrt(np.mean(uncertainty.std[reached] ** 2))) if len(unknown) else 0.0
    if rms > max(WORTH_TELLING, stated):
        told.append(
            f"The data do not determine {listed(uncertainty.blamed, 4)}, on which the place of "
            f"this point depends: typical deviations of them would move it by {rms * 1e6:.0f} µm "
            "rms, which the stated uncertainty leaves out; choose a marker that was fitted "
            f"({option('point')}), or measure what is missing"
        )
    return tuple(told)


def _without_load(cell: Cell, targets: Targets) -> list[str]:
    """A load that was forgotten: the commands are then those of the arm without it."""
    spec = cell.model
    elastic = any(effect_of(choice.name).elastic for choice in spec.effects)
    if not elastic or targets.table.force.any() or spec.link_gravity or spec.torque != "computed":
        return []
    return [
        f"{targets.table.source}: no load is stated, so no compliance is compensated; where the "
        f"tool carries one, give {option('load')} or force_x_N, force_y_N, force_z_N"
    ]


def _beyond_levels(cell: Cell, targets: Targets, q: Array, reached: NDArray[np.bool_]) -> list[str]:
    told = []
    for name, values in cell.model.compliance_levels.items():
        angle = q[:, int(name.removeprefix("joint")) - 1]
        off = (angle < min(values) - LEVEL_SLACK) | (angle > max(values) + LEVEL_SLACK)
        if (off & reached).any():
            told.append(
                f"{_rows(targets, off & reached)}: {name} stands beyond its levels in "
                "[model.compliance_levels], where the compliance of the nearest level is assumed"
            )
    return told


def _rows(targets: Targets, which: NDArray) -> str:
    """ "targets.csv, line 7 and 3 more" of a mask or of row indices."""
    rows = np.flatnonzero(which) if which.dtype == bool else which
    more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
    return f"{targets.place(int(rows[0]))}{more}"
