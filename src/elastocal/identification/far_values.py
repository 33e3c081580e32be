"""Values far from nominal: a joint to remaster, a robot file of another arm, a missing effect."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from elastocal.identification.result import Calibration, Finding
from elastocal.identification.start import OF_A_TARGET, SCALED, linear_fits
from elastocal.model.arm import Parameter
from elastocal.model.effects.compliances import JointCompliance
from elastocal.model.effects.gears import JointOffset
from elastocal.model.effects.placements import LinkGeometry, TrackerDistortion
from elastocal.text import listed

# How large a value is says nothing by itself.  Where the noise explains what is left and held-out
# poses agree, the value is what the arm has; where much is left, a value that no arm has stands in
# for what the model lacks.

LARGEST = 0.5  # beyond it the points hardly move, as of a tip that touches one, or do so otherwise
NEARLY = 0.1  # share of the square that a scale leaves of what it explains
SOME = 400  # readings that are enough for it
FEWEST_POSES = 8
FAR = 10.0  # typical deviations from nominal, beyond which an arm that works has no parameter
# What the nominal arm states and a first cell fits.  Base and markers are guesses, and any other
# effect is in the cell because someone named it: their sizes are findings, no evidence.
STATED_BY_FILE = (JointOffset.name, LinkGeometry.name, JointCompliance.name)


def far_values(result: Calibration, explained: bool, lacking: str) -> Iterator[Finding]:
    """Values whose interval leaves nominal out, and which lie more than FAR typical deviations off.

    `explained`: the noise explains the residual, and held-out poses agree; else such values are
    doubted with the remedy `lacking`.
    """
    half = _half_widths(result)
    zeros: list[tuple[Parameter, float]] = []
    others: list[tuple[Parameter, float]] = []
    sizes: dict[str, float] = {}
    for p, value in zip(result.model.parameters, result.x, strict=True):
        if p.effect not in STATED_BY_FILE or not p.typical or p.name not in half:
            continue
        off = float(value) - p.nominal
        if abs(off) > max(FAR * p.typical, half[p.name]):
            sizes[p.name] = abs(off) / p.typical
            (zeros if p.effect == JointOffset.name else others).append((p, off))
    if zeros:
        told = [f"{p.where.replace('joint', 'joint ')} is off by {_size(off, p.unit)} (known to "
                f"{_size(half[p.name], p.unit)})" for p, off in zeros]  # fmt: skip
        yield Finding(
            "joint_zero", "note",
            {
                "joints": tuple(p.where for p, _ in zeros), "values": tuple(v for _, v in zeros),
                "units": tuple(p.unit for p, _ in zeros),
                "ci95_half": tuple(half[p.name] for p, _ in zeros),
            },
            f"The zero of {listed(told)}: remaster it, or command the arm by this calibration.",
        )  # fmt: skip
    scale = scale_of(result)
    if scale is not None:
        other = abs(scale - 1) > OF_A_TARGET
        yield Finding(
            "scale", "care",
            {"readings_over_file": scale, "likely": "another robot" if other else "a scale error"},
            "Check that the cell describes the robot that was measured ([robot]): no target or "
            "scale bar is wrong by so much."
            if other
            else "Look for what scales the readings: the size stated of a tag or scale bar, or a "
            f"unit. Multiplied by {1 / scale:.4g} they have the lengths of the robot's file.",
        )  # fmt: skip
        return
    others.sort(key=lambda found: -sizes[found[0].name])
    if others:
        told = [f"{p.name} by {_size(off, p.unit)} ({_size(half[p.name], p.unit)})"
                for p, off in others]  # fmt: skip
        yield Finding(
            "far_from_nominal" if explained else "unheard_of", "note" if explained else "care",
            {
                "parameters": tuple(p.name for p, _ in others),
                "typical_sizes": tuple(sizes[p.name] for p, _ in others),
                "values": tuple(float(v) + p.nominal for p, v in others),
                "units": tuple(p.unit for p, _ in others),
                "readings_set_apart": len(result.excluded),
            },
            "The arm is not the one of the robot's file: compare its lengths and angles with the "
            f"data sheet (off, and known to: {listed(told, 3)})."
            if explained
            else lacking,
        )  # fmt: skip


def scale_of(result: Calibration) -> float | None:
    """By what factor all lengths that were read exceed those of the nominal arm; None where no such
    scale shows.

    The linear map A of the readings onto the nominal arm is a rotation with a scale where that is
    wrong.  One that takes nine tenths of the square away, differs less between directions than from
    one, and is larger than any arm's lengths err together, is one of the readings.
    """
    table = result.observations.table
    own = any(p.effect == TrackerDistortion.name for p in result.model.parameters)
    if table.position is None or own or len(np.unique(table.q, axis=0)) < FEWEST_POSES:
        return None
    extent = float(np.linalg.norm(np.ptp(table.position, axis=0)))
    if not SCALED * extent / 10 < result.nominal_rms < math.inf:
        return None
    table = table.take(result.observations.lead[:: max(len(result.observations.lead) // SOME, 1)])
    flange = result.model.rigid.flange_poses(table)
    found = linear_fits(flange[None], np.asarray(table.position), table.marker)
    if not 3 * found.left[0] ** 2 < NEARLY * result.nominal_rms**2:
        return None
    size = np.linalg.svd(found.matrix[0], compute_uv=False)
    off = abs(float(found.scale[0]) - 1)
    alike = found.determinant[0] > 0 and size[0] - size[-1] < off
    return 1 / float(found.scale[0]) if alike and SCALED < off < LARGEST else None


def _half_widths(result: Calibration) -> dict[str, float]:
    """Half the 95 % interval of each value that was determined, alone or in a sum."""
    ends = {e.name: e.ci95 for e in result.estimates if e.ci95 is not None}
    ends |= {next(iter(c.terms)): c.ci95 for c in result.combinations}
    return {name: (high - low) / 2 for name, (low, high) in ends.items()}


def _size(value: float, unit: str) -> str:
    """A length in mm, an angle in degrees, as mastering has them."""
    number, unit = {"m": (value * 1e3, " mm"), "rad": (math.degrees(value), "°")}.get(
        unit, (value, f" {unit}")
    )
    return f"{abs(number):.{2 if abs(number) < 10 else 3}g}{unit}"
