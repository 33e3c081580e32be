"""Joints that come to rest elsewhere: play, friction behind the encoder, and what lags behind.

From which side a joint came says the table's `approach_i`; with `[model] approach = "order"` the
order of the visits does, by times where they are recorded, else by rows (`with_moves`).  That the
arm was measured in that order and went straight from pose to pose is an assumption.
"""

from __future__ import annotations

import casadi as ca

from elastocal.cell.work_cell import Cell
from elastocal.model.arm import Arm, ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Effect, Symbols, index
from elastocal.model.effects.compliances import (
    TorqueEffect,
    add_deflection,
    rated_torque,
    torque_scale,
)
from elastocal.model.effects.driven import DrivenEffect, JointMotion

FRICTION = 3.0  # times τ_s: the load's torque that friction holds up
BY_ORDER = "order"


def came_from(arm: Arm) -> ca.SX:
    """±1 (n,): the direction of each joint's last motion, by column or by order of visits."""
    ordered = arm.cell.model.approach == BY_ORDER
    return arm.input("direction" if ordered else "approach", arm.chain.n_joints)


def unmoved(arm: Arm) -> ca.SX:
    """1 (n,) where a joint has not moved yet in the campaign, else 0; 0 at all other poses."""
    return arm.input("unmoved", arm.chain.n_joints)


class Backlash(TorqueEffect):
    """δq = (β/2) tanh(τ/τ_s): the joint rests at the end of its play that the load τ drives it to.

    β in rad is the whole play.  tanh is sgn with the dead zone |τ| < τ_s in which friction and
    the balance of the teeth leave the joint between both flanks: a thousandth of its rated torque.
    Where the table says from which side a joint came ([model] play_side = "load_and_approach"),
    δq = (β/2) tanh((τ − a τ_f)/τ_s): a load below the friction τ_f = 3 τ_s does not turn the
    teeth, and the joint lags behind its last motion a = ±1.  τ is the torque of all loads that the
    model has; where the links' weights decide the side, switch `link_gravity` on.
    """

    name = "backlash"
    stage = "transmission"
    at = "turning joints"
    unknowns = (ParameterSpec("backlash", "rad", 0.0, 2e-4, lower=0.0),)

    def needed(self, cell: Cell) -> tuple[str, ...]:
        sided = cell.model.play_side == "load_and_approach" and cell.model.approach != BY_ORDER
        return (*super().needed(cell), "approach") if sided else super().needed(cell)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale = torque_scale(arm.chain, arm.cell, i)
        play = p["backlash"]
        held: ca.SX | float = 0.0
        if arm.cell.model.play_side == "load_and_approach":
            held = FRICTION * scale * came_from(arm)[i]

        def law(tau: ca.SX) -> ca.SX:
            return play / 2 * ca.tanh((tau - held) / scale)

        add_deflection(arm, i, f"{place}.backlash", law)


class Hysteresis(Effect):
    """δq = a (h + g |τ|), a = ±1 the direction of the joint's last motion.

    h in rad, g in rad/(N m).  Dry friction behind the encoder keeps the drive train wound up
    after it stops; friction grows with the load τ on the teeth and bearings, hence g.  |τ| is
    smooth: √(τ² + τ_s²) − τ_s with τ_s a thousandth of the joint's rated torque.
    """

    name = "hysteresis"
    stage = "transmission"
    at = "turning joints"
    needs = ("approach",)

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return () if cell.model.approach == BY_ORDER else self.needs

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = 5e-5
        rated = rated_torque(chain, cell, index(place))
        growth = size / rated if rated else None
        return (
            ParameterSpec("hysteresis", "rad", 0.0, size),
            ParameterSpec("hysteresis_per_torque", "rad/(N*m)", 0.0, growth),
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale = torque_scale(arm.chain, arm.cell, i)
        direction = came_from(arm)[i]

        def law(tau: ca.SX) -> ca.SX:
            magnitude = ca.sqrt(tau**2 + scale**2) - scale
            return direction * (p["hysteresis"] + p["hysteresis_per_torque"] * magnitude)

        add_deflection(arm, i, f"{place}.hysteresis", law)


NEVER = 1e-12  # rad; far below any move, so that no move at all makes no quotient of zeros


class MoveLag(DrivenEffect):
    """δq_j = a Δq_j / max_k |Δq_k| + b sgn Δq_j, Δq the arm's last move; a and b in rad.

    A controller moves all joints for as long as the slowest one takes, so that joint j arrives
    with a speed in proportion to Δq_j / max |Δq|: a servo that stops short, oil and rubber that
    settle only after the reading leave an error in proportion to that speed (a), friction one of
    a fixed size (b).  Δq is the visit's q minus that of the visit before it, in the order of the
    times, or of the rows where there are none: an assumption that can be tested, for the same
    visits in another order must fit worse.  How the arm came to the first visit nobody knows: it
    has an error c of its own.
    """

    name = "move_lag"
    stage = "transmission"
    at = "turning joints"
    family = "move"
    entry = JointMotion()
    unknowns = (
        ParameterSpec("move_lag", "rad", 0.0, 1e-4),
        ParameterSpec("move_lag_sign", "rad", 0.0, 5e-5),
        ParameterSpec("move_lag_first", "rad", 0.0, 5e-5),
    )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        move = arm.input("move", arm.chain.n_joints)
        own = move[index(place)]
        longest = ca.mmax(ca.fabs(move)) + NEVER
        moved = p["move_lag"] * own / longest + p["move_lag_sign"] * ca.sign(own)
        return moved + p["move_lag_first"] * unmoved(arm)[index(place)]


class MoveHysteresis(DrivenEffect):
    """δq_j = b sgn Δq_j, Δq_j the last motion of the joint itself; b in rad.

    `Hysteresis` that does not grow with the load, for tables without `approach`: from which side
    the joint came is taken from the order of the visits, with the assumption that `MoveLag` makes.
    Until the joint has moved it has an error of its own.
    """

    name = "move_hysteresis"
    stage = "transmission"
    at = "turning joints"
    unless = "approach"
    family = "move"
    entry = JointMotion()
    unknowns = (
        ParameterSpec("move_hysteresis", "rad", 0.0, 5e-5),
        ParameterSpec("move_hysteresis_first", "rad", 0.0, 5e-5),
    )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        side = arm.input("direction", arm.chain.n_joints)[index(place)]
        return p["move_hysteresis"] * side + p["move_hysteresis_first"] * unmoved(arm)[index(place)]
