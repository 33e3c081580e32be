"""What the gears make of the commanded joints: offsets, harmonics, couplings, play and lag."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from elastocal.cell import Cell
from elastocal.messages import require
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    MOTION,
    OFFSET,
    Arm,
    DrivenEffect,
    Effect,
    JointMotion,
    ParameterSpec,
    Setting,
    Symbols,
    index,
    joints,
)
from elastocal.model.effects.statics import (
    TorqueEffect,
    add_deflection,
    rated_torque,
    torque_scale,
)


class JointOffset(Effect):
    """δq = a: the joint's zero differs from nominal by a (rad, or m for a prismatic joint)."""

    name = "joint_offset"
    stage = "transmission"
    at = "joints"
    rank = OFFSET
    formats = ("rigid", "elastic")
    unknowns = (ParameterSpec("offset", MOTION, 0.0, 1e-3),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.q[index(place)] += p["offset"]


class EncoderScale(DrivenEffect):
    """δq = a·q with the commanded joint value q; a is dimensionless."""

    name = "encoder_scale"
    stage = "transmission"
    entry = JointMotion()
    unknowns = (ParameterSpec("encoder_scale", "1", 0.0, 3e-4),)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return p["encoder_scale"] * arm.q_commanded[index(place)]


def sine_and_cosine(key: str, typical: float) -> tuple[ParameterSpec, ...]:
    return tuple(ParameterSpec(f"{key}_{part}", "rad", 0.0, typical) for part in ("sin", "cos"))


class GearHarmonic(DrivenEffect):
    """δq = a sin Nq + b cos Nq with the commanded joint angle q; a and b in rad.

    A subclass states the order N and the two parameters.
    """

    stage = "transmission"
    at = "turning joints"
    entry = JointMotion()
    N: ClassVar[int | None] = None  # periods of the error in one turn; None: a setting says it

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        phase = (self.N or p["ripple_order"]) * arm.q_commanded[index(place)]
        a, b = (p[spec.key] for spec in self.unknowns)
        return a * ca.sin(phase) + b * ca.cos(phase)


class GearEccentricity(GearHarmonic):
    """δq = a sin q + b cos q with the commanded joint angle q; a and b in rad.

    The last gear wheel of a drive, or the disc of an encoder behind it, turns about a point at
    distance e from its own centre: the joint runs ahead by e/r and behind by as much once per
    turn, r the radius of the pitch circle or of the graduation.  √(a² + b²) = e/r, and
    atan2(b, a) is where the eccentricity points.  Source: Whitney, Lozinski and Rourke 1986,
    "Industrial robot forward calibration method and results" (the first-order gear error).
    """

    name = "gear_eccentricity"
    unknowns = sine_and_cosine("eccentricity", 1e-4)
    N = 1


class GearSecondHarmonic(GearHarmonic):
    """δq = a sin 2q + b cos 2q with the commanded joint angle q; a and b in rad.

    An oval wheel, a strain-wave gear whose flexible spline is pressed against a circular spline
    that is not round, two reading heads of an encoder with an oval disc or a shaft that wobbles
    in a universal joint: ahead and behind twice per turn.
    """

    name = "gear_second_harmonic"
    unknowns = sine_and_cosine("harmonic2", 5e-5)
    N = 2


class GearRipple(GearHarmonic):
    """δq = a sin Nq + b cos Nq with the commanded joint angle q; a and b in rad.

    N is a number of teeth, the ratio of a stage (an eccentric input wheel turns N times per turn
    of the joint) or a product of both, and need not be whole: the transmission error of spur,
    cycloidal and strain-wave gears.  The orders come from `[model] gear_ripple_orders`, one per
    joint or a single one for all, or from `settings.jointN = { ripple_order = … }`.
    """

    name = "gear_ripple"
    unknowns = sine_and_cosine("ripple", 5e-5)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        orders = cell.model.gear_ripple_orders
        require(
            len(orders) in (0, 1, chain.n_joints),
            f"{cell.source}: [model] gear_ripple_orders has {len(orders)} values, but "
            f"the arm has {chain.n_joints} joints; give one per joint, or a single one for all",
        )
        default = orders[index(place) % len(orders)] if orders else None
        return (Setting("ripple_order", "order", default, 0.5, 1000.0),)


MOST_LINES = 40
WHOLE = 1e-9


class GearSpectrum(DrivenEffect):
    """δq = Σ_k a_k sin N_k q + b_k cos N_k q, lines of real orders N_k; a_k and b_k in rad.

    A gear with several stages has lines at each wheel's turns, at its teeth and at their
    multiples, at once.  Settings: `order_1` … `order_40` in periods per turn (0, the default: no
    line; as many as the cell names), the prior size `spectrum_size_rad` of a_k and b_k, an n-th of
    it where N_k is n times another line's order.

    An order that was estimated with the standard deviation `order_sd_k` brings the derivative by
    N_k beside its line, (q − q₀)(c_k cos N_k q − d_k sin N_k q) with c_k = a_k δN_k and
    d_k = b_k δN_k of that prior size times `order_sd_k`; q₀ = `spectrum_centre_rad` is the middle
    of the angles that the order was estimated from.
    """

    name = "gear_spectrum"
    stage = "transmission"
    at = "turning joints"
    together = True
    family = "angle"
    sized_by = "spectrum_size_rad"
    entry = JointMotion()

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        stated = cell.model.nominal.settings.get(place, {})
        known = range(1, MOST_LINES + 1)
        lines = max((k for k in known if f"order_{k}" in stated), default=1)
        orders = (Setting(f"order_{k}", "order", 0.0, 0.0, 1000.0) for k in known[:lines])
        spreads = (Setting(f"order_sd_{k}", "range", 0.0, 0.0, 1000.0) for k in known[:lines])
        return (
            Setting("spectrum_size_rad", "range", 5e-5, 1e-12, 1.0),
            Setting("spectrum_centre_rad", "range", 0.0, -100.0, 100.0),
            *orders,
            *spreads,
        )

    def lines(self, place: str, chain: Chain, cell: Cell) -> dict[int, tuple[float, float]]:
        """Numbers of the lines that there are: each one's order, and how uncertain that is."""
        given = self.stated(place, chain, cell)
        known = range(1, MOST_LINES + 1)
        return {
            k: (given[f"order_{k}"], given[f"order_sd_{k}"])
            for k in known if given.get(f"order_{k}", 0.0) > 0
        }  # fmt: skip

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        whole = self.stated(place, chain, cell)[self.sized_by]
        lines, specs = self.lines(place, chain, cell), []
        for k, (order, sd) in lines.items():
            # As many times the lowest line's order that it is a multiple of.
            ratios = (order / other for other, _ in lines.values())
            size = whole / max(round(r) for r in ratios if abs(r - round(r)) < WHOLE)
            parts = [("sin", size), ("cos", size)]
            parts += [("sin_shift", size * sd), ("cos_shift", size * sd)] if sd > 0 else []
            specs += [
                ParameterSpec(f"line_{k}_{part}", "rad", 0.0, s, shrunk=True) for part, s in parts
            ]
        return tuple(specs)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        q, u = arm.q_commanded[index(place)], ca.SX(0)
        for k, (_, sd) in self.lines(place, arm.chain, arm.cell).items():
            sine, cosine = ca.sin(p[f"order_{k}"] * q), ca.cos(p[f"order_{k}"] * q)
            u += p[f"line_{k}_sin"] * sine + p[f"line_{k}_cos"] * cosine
            if sd > 0:
                turned = p[f"line_{k}_sin_shift"] * cosine - p[f"line_{k}_cos_shift"] * sine
                u += (q - p["spectrum_centre_rad"]) * turned
        return u


class WristCoupling(DrivenEffect):
    """δq₅ = a q₄, δq₆ = b q₄ + c q₅ of six joints; of n, the last three.

    Drives of a wrist sit in the forearm and reach their joints through hollow shafts, so that
    turning one joint turns those behind it, which the controller undoes with its coupling
    ratios.  a, b and c (dimensionless) are the errors of those ratios.
    """

    name = "wrist_coupling"
    stage = "transmission"
    entry = JointMotion()
    unknowns = tuple(ParameterSpec(f"coupling_{k}", "1", 0.0, 2e-4) for k in "abc")

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        turning = chain.n_joints >= 6 and set(chain.kinds[-3:]) == {"revolute"}
        return ("wrist",) if turning else ()

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return joints(chain)[-2:]

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        n = arm.chain.n_joints
        first, second = arm.q_commanded[n - 3], arm.q_commanded[n - 2]
        return ca.vertcat(
            p["coupling_a"] * first, p["coupling_b"] * first + p["coupling_c"] * second
        )


# Joints that come to rest elsewhere: play, friction behind the encoder, and what lags behind.
# From which side a joint came says the table's `approach_i`; with `[model] approach = "order"` the
# order of the visits does, by times where they are recorded, else by rows (`with_moves`).  That the
# arm was measured in that order and went straight from pose to pose is an assumption.

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
