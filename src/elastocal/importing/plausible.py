"""Numbers that no arm measured by a tracker gives: most often a unit mistaken."""

from __future__ import annotations

import numpy as np

from elastocal.importing.assemble import Assembled
from elastocal.measurements import Measurements
from elastocal.text import listed

# Industrial arms measured by trackers: radians of a campaign span more than this, degrees too.
SMALLEST_SPREAD_DEG = 7.0  # 2 pi: a column of radians read as degrees spans less
LARGEST_TURN = 4 * np.pi
FARTHEST_M, LARGEST_SPREAD_M, LEAST_SPREAD_M = 150.0, 30.0, 0.02
LARGEST_FORCE_N = 2e5
LARGEST_SIGMA_M = 5e-3


def plausibility(made: Assembled, table: Measurements, observe: str | None) -> list[str]:
    """Sentences about columns that are likely in another unit, and about pairs that are missing."""
    with np.errstate(over="ignore"):  # numbers of 1e300 are told as implausible, too
        warnings = [*_joints(made, table), *_positions(table)]
        force = np.linalg.norm(table.force, axis=1)
    if force.max() > LARGEST_FORCE_N:
        warnings.append(
            f"forces reach {force.max():.3g} N, more than any arm carries; check [loads]"
        )
    if table.sigma is not None and table.sigma.max() > LARGEST_SIGMA_M:
        warnings.append(
            f"standard deviations reach {table.sigma.max() * 1e3:.3g} mm; are they in µm?"
        )
    if table.position is not None and np.any(table.force[:, 2] > 0):
        warnings.append(
            "some forces point up (+z of the tracker's frame); a hanging load is negative"
        )
    if observe == "deflection":
        warnings += _pairs(table)
    return warnings


def _joints(made: Assembled, table: Measurements) -> list[str]:
    revolute = np.array([kind == "revolute" for kind in made.kinds])
    q = table.q[:, revolute]
    if not q.size:
        return []
    first = next(header for header in made.columns if header.startswith("q1"))
    if np.abs(q).max() > LARGEST_TURN:
        return [
            f"a joint stands at {np.degrees(np.abs(q).max()):.4g}°, more than two turns: degrees "
            "read as radians? Map q#_deg"
        ]
    several = len(np.unique(table.q, axis=0)) >= 5
    if (
        several
        and first.endswith("_deg")
        and np.degrees(np.ptp(q, axis=0)).max() < (SMALLEST_SPREAD_DEG)
    ):
        return [
            f"no joint moves by more than {np.degrees(np.ptp(q, axis=0)).max():.3g}°: radians read "
            "as degrees? Map q#_rad"
        ]
    still = [f"joint {j + 1}" for j in range(table.q.shape[1]) if np.ptp(table.q[:, j]) == 0]
    if several and still:
        return [f"{listed(still)} never moved; is it mapped to the right column?"]
    return []


def _positions(table: Measurements) -> list[str]:
    if table.position is None:
        return []
    far = float(np.linalg.norm(table.position, axis=1).max())
    spread = float(np.linalg.norm(np.ptp(table.position, axis=0)))
    if far > FARTHEST_M or spread > LARGEST_SPREAD_M:
        return [
            f"points lie up to {far:.3g} m from the tracker and span {spread:.3g} m: mm read as m? "
            "Map x_mm, y_mm, z_mm"
        ]
    moved = float(np.ptp(table.q, axis=0).max()) if len(table) else 0.0
    if moved > 0.3 and spread < LEAST_SPREAD_M:
        return [
            f"all points lie within {spread * 1e3:.3g} mm although the arm moved: m read as mm? "
            "Map x_m, y_m, z_m"
        ]
    return []


def _pairs(table: Measurements) -> list[str]:
    """Configurations that lack the loaded or the unloaded state, which deflections need."""
    loaded = np.any(table.force != 0, axis=1)
    lonely = [
        label
        for code, label in enumerate(table.configuration_labels)
        if (here := table.configuration == code).any() and len(set(loaded[here])) < 2
    ]
    if not lonely:
        return []
    return [
        f"{len(lonely)} of {len(table.configuration_labels)} configurations were not measured both "
        f"unloaded and loaded, as deflections need: {listed(lonely, 8)}"
    ]
