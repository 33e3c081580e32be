"""A gear wheel or encoder disc that sits off its centre."""

from __future__ import annotations

import casadi as ca

from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.gear_harmonic import GearHarmonic


class GearEccentricity(GearHarmonic):
    """δq = a sin q + b cos q with the commanded joint angle q; a and b in rad.

    The last gear wheel of a drive, or the disc of an encoder behind it, turns about a point at
    distance e from its own centre: the joint runs ahead by e/r and behind by as much once per
    turn, r the radius of the pitch circle or of the graduation.  √(a² + b²) = e/r, and
    atan2(b, a) is where the eccentricity points.  Source: Whitney, Lozinski and Rourke 1986,
    "Industrial robot forward calibration method and results" (the first-order gear error).
    """

    name = "gear_eccentricity"
    prefix = "eccentricity"
    typical = 1e-4

    def order(self, p: Symbols) -> ca.SX:
        return ca.SX(1)
