"""A gear or bearing that is oval: an error twice per turn."""

from __future__ import annotations

import casadi as ca

from elastocal.manipulator.effects.base import Symbols
from elastocal.manipulator.effects.gear_harmonic import GearHarmonic


class GearSecondHarmonic(GearHarmonic):
    """δq = a sin 2q + b cos 2q with the commanded joint angle q; a and b in rad.

    An oval wheel, a strain-wave gear whose flexible spline is pressed against a circular spline
    that is not round, two reading heads of an encoder with an oval disc or a shaft that wobbles
    in a universal joint: ahead and behind twice per turn.
    """

    name = "gear_second_harmonic"
    prefix = "harmonic2"
    typical = 5e-5

    def order(self, p: Symbols) -> ca.SX:
        return ca.SX(2)
