"""Ripple of a gear's teeth, or of a wheel that turns faster than the joint."""

from __future__ import annotations

import casadi as ca

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Symbols, index
from elastocal.manipulator.effects.gear_harmonic import GearHarmonic
from elastocal.manipulator.parameter import Setting


class GearRipple(GearHarmonic):
    """δq = a sin Nq + b cos Nq with the commanded joint angle q; a and b in rad.

    N is a number of teeth, the ratio of a stage (an eccentric input wheel turns N times per turn
    of the joint) or a product of both, and need not be whole: the transmission error of spur,
    cycloidal and strain-wave gears.  The orders come from `[model] gear_ripple_orders`, one per
    joint or a single one for all, or from `settings.jointN = { ripple_order = … }`.
    """

    name = "gear_ripple"
    prefix = "ripple"
    typical = 5e-5

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        orders = cell.model.gear_ripple_orders
        require(
            len(orders) in (0, 1, chain.n_joints),
            f"{cell.path or cell.name}: [model] gear_ripple_orders has {len(orders)} values, but "
            f"the arm has {chain.n_joints} joints; give one per joint, or a single one for all",
        )
        default = orders[index(place) % len(orders)] if orders else None
        return (Setting("ripple_order", "order", default, 0.5, 1000.0),)

    def order(self, p: Symbols) -> ca.SX:
        return p["ripple_order"]
