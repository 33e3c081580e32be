"""Where base, links, markers and anchor stand, how that changes while one measures, and what the
gears make of the commanded joints: offsets, harmonics, couplings, play and lag."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.messages import require
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    LINK,
    MARKER,
    MOTION,
    MOVE,
    OFFSET,
    SHORTEST,
    STATION,
    Arm,
    BaseMotion,
    DrivenEffect,
    Effect,
    JointMotion,
    LinkFrame,
    LinkLength,
    MarkerMotion,
    ParameterSpec,
    Setting,
    Symbols,
    index,
    joints,
    links,
)
from elastocal.model.effects.statics import TorqueEffect, add_deflection, rated_torque, torque_scale

KEYS = ("x", "y", "z", "rx", "ry", "rz")


class BaseFrame(Effect):
    """T_tracker_base = Trans(x, y, z) · exp([rx, ry, rz]×), absolute values.

    Position in m, rotation vector in rad, both in the tracker frame.  The rotation vector is
    regular up to a full turn, so the tracker may be turned any way.
    """

    name, stage, at = "base_frame", "tracker", "base"
    registered = True
    rank = STATION
    formats = ("rigid", "elastic")
    of_the_measurement = False  # where the base stands is the arm's

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.model.nominal
        position = np.zeros(3) if nominal.base_position is None else nominal.base_position
        rotation = np.eye(3) if nominal.base_rotation is None else nominal.base_rotation
        vector = ca.evalf(rigid.vector_from_rotation(rotation)).elements()
        known = zip(KEYS, MOVE, [*position, *vector], strict=True)
        return tuple(ParameterSpec(k, u, float(v), 3e-3) for k, u, v in known)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        position = ca.vertcat(p["x"], p["y"], p["z"])
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        arm.T_tracker_base = rigid.transform(rigid.rotation_from_vector(vector), position)


class LinkGeometry(Effect):
    """T_link = T_nominal · Trans(dx, dy, dz) · exp([rx, ry, rz]×) at the link's distal end.

    T_nominal takes the next joint's frame (the flange's for the last link) to this link's
    joint frame; the error moves and tilts that next frame, in m and rad, along its own axes.
    Six per link are complete but redundant; identification reduces them to a minimal set
    (Stone 1987; Hollerbach, Khalil and Gautier 2008).
    """

    name, stage, at = "link_geometry", "geometry", "links"
    rank = LINK
    formats = ("rigid", "elastic")
    unknowns = (
        *(ParameterSpec(k, "m", 0.0, 1e-3) for k in ("dx", "dy", "dz")),
        *(ParameterSpec(k, "rad", 0.0, 1e-3) for k in ("rx", "ry", "rz")),
    )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        LinkFrame().enter(arm, place, ca.vertcat(*[p[spec.key] for spec in self.unknowns]))


class MarkerPosition(Effect):
    """Position (x, y, z) in m of each marker in the flange frame, absolute values.

    For distances this is the cable's or ball-bar's attachment point.
    """

    name, stage, at = "marker_position", "tool", "markers"
    registered = True
    rank = MARKER
    formats = ("rigid", "elastic")

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = zip("xyz", cell.tool.markers[place.removeprefix("marker:")], strict=True)
        return tuple(ParameterSpec(k, "m", float(v), 3e-3) for k, v in nominal)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.markers[place.removeprefix("marker:")] = ca.vertcat(p["x"], p["y"], p["z"])


class MarkerOrientation(Effect):
    """R_flange_target = exp([rx, ry, rz]×), rotation vector in rad; nominal: as the flange."""

    name, stage, at = "marker_orientation", "tool", "markers"
    registered = True
    rank = MARKER
    formats = ("rigid", "elastic")
    seen_in = "pose"
    unknowns = tuple(ParameterSpec(k, "rad", 0.0, 3e-3) for k in ("rx", "ry", "rz"))

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        arm.marker_rotation[place.removeprefix("marker:")] = rigid.rotation_from_vector(vector)


class DistanceSensor(Effect):
    """reading = |p_marker − p_anchor| + offset; anchor (x, y, z) and offset in m.

    The anchor is in the frame of the data (the robot's base frame unless `base_frame` is fitted
    or given).
    """

    name, stage = "distance_sensor", "tracker"
    seen_in = "distance"
    at = "tracker"
    registered = True
    rank = STATION

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.tracker.anchor if cell.tracker.anchor is not None else np.zeros(3)
        known = zip("xyz", nominal, strict=True)
        anchor = (ParameterSpec(f"anchor_{k}", "m", float(v), 3e-3) for k, v in known)
        return (*anchor, ParameterSpec("length_offset", "m", 0.0, 3e-3))

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.anchor = ca.vertcat(p["anchor_x"], p["anchor_y"], p["anchor_z"])
        arm.length_offset = p["length_offset"]


# What the instrument distorts.

ENCODERS = ("azimuth_sin", "azimuth_cos", "elevation_sin", "elevation_cos")


class TrackerDistortion(Effect):
    """Range, refraction and angle-encoder errors of a polar instrument at `[tracker] position_m`.

    With azimuth A, elevation E, range r and horizontal range s of the marker:
    A ← A + azimuth_sin·sin A + azimuth_cos·cos A, E likewise, r ← (1 + scale) r, then
    z ← z + refraction·s².  Eccentric circles shift an encoder's reading once per turn (rad); a
    wrong wavelength, air temperature or pressure scales the range (1); a vertical gradient of
    the air's temperature bends the beam, 1/m (half its curvature, 1 K/m makes 5e-7).  z is
    vertical.  Distances of a wire or ball-bar have no such errors, hence no place.  Source:
    Muralikrishnan et al. 2009, "ASME B89.4.19 performance evaluation tests and geometric
    misalignments in laser trackers"; Hughes et al. 2011, "Laser tracker error determination using a
    network measurement".
    """

    name, stage = "tracker_distortion", "tracker"
    remedy = (
        "measure a reference length (scale bar) or set the tracker up in a second place: that "
        "tells its errors from the arm's"
    )
    # Data sheets promise 12 µrad and 5 ppm; an instrument that is out by ten times the typical size
    # is one to be mended, and what is out by more is no instrument's error.
    most = 10.0
    unknowns = (
        ParameterSpec("scale", "1", 0.0, 2e-5),
        ParameterSpec("refraction", "1/m", 0.0, 1e-6),
        *(ParameterSpec(key, "rad", 0.0, 2e-5) for key in ENCODERS),
    )

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return () if cell.model.observe == "distance" else ("tracker",)

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return (*self.needs, *["station"] * (not cell.tracker.position.any()))

    def read(self, arm: Arm, place: str, p: Symbols) -> None:
        station = rigid.constant(arm.cell.tracker.position)
        x, y, z = ca.vertsplit(ca.densify(arm.reading["position"] - station))
        # Angles enter by their sines and cosines alone, so that no direction is special.
        horizontal = ca.sqrt(x**2 + y**2 + rigid.TINY)
        slant = ca.sqrt(x**2 + y**2 + z**2 + rigid.TINY)
        azimuth = (p["azimuth_sin"] * y + p["azimuth_cos"] * x) / horizontal
        elevation = (p["elevation_sin"] * z + p["elevation_cos"] * horizontal) / slant
        x, y = _turned(x, y, azimuth)
        outward, z = _turned(horizontal, z, elevation)
        x, y = x * outward / horizontal, y * outward / horizontal
        observed = (1 + p["scale"]) * ca.vertcat(x, y, z)
        sag = p["refraction"] * ca.sumsqr(observed[:2])
        arm.reading["position"] = station + observed + ca.vertcat(0, 0, sag)


def _turned(a: ca.SX, b: ca.SX, angle: ca.SX) -> tuple[ca.SX, ca.SX]:
    c, s = ca.cos(angle), ca.sin(angle)
    return c * a - s * b, s * a + c * b


# What changes while one measures: references, base, tracker, markers and lengths.

MEASURE_MONUMENTS = (
    "measure fixed reflectors (monuments) on the floor and on the robot's foot along with the "
    "arm: they tell the tracker's motion, the base's and a joint's apart"
)
TIME_CONSTANT = Setting("time_constant_s", "time_constant", 1800.0, 60.0, 1e6)


def pose_change(prefix: str, length: float, turn: float = 5e-5) -> tuple[ParameterSpec, ...]:
    """`prefix`_x … `prefix`_rz with typical sizes `length` in m and `turn` in rad."""
    sizes = {"m": length, "rad": turn}
    known = zip(KEYS, MOVE, strict=True)
    return tuple(ParameterSpec(f"{prefix}_{k}", unit, 0.0, sizes[unit]) for k, unit in known)


class WarmUp(DrivenEffect):
    """u = d (1 − exp(−t/T)), d all parameters of the place: 0 at t = 0, d when warm.

    The response of a body with one thermal time constant T = `time_constant_s` to a constant source
    of heat that is switched on at t = 0, the table's time.
    """

    constants: ClassVar[tuple[Setting, ...]] = (TIME_CONSTANT,)
    needs = ("time",)

    def course(self, arm: Arm, p: Symbols) -> ca.SX:
        return 1 - ca.exp(-arm.input("time", 1) / p["time_constant_s"])

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        specs = self.parameters(place, arm.chain, arm.cell)
        return ca.vertcat(*[p[spec.key] for spec in specs]) * self.course(arm, p)


JUMP_TIME = Setting("jump_time_s", "change_time", None, -np.inf, np.inf)


class Jump(WarmUp):
    """u = d for t ≥ T, d all parameters of the place and T the one setting, in s: nobody knows
    beforehand when something changed."""

    any_size = True
    constants: ClassVar[tuple[Setting, ...]] = (JUMP_TIME,)

    def course(self, arm: Arm, p: Symbols) -> ca.SX:
        return arm.input("moment", 1) >= p[self.constants[0].key]


class JointDrift(WarmUp):
    """δq = d (1 − exp(−t/T)): the joint's reference has moved by d (rad or m) once warm.

    Gears and encoder mounts warm up with the motor beside them and shift the joint's zero; t is
    the table's time from its origin, T the setting `time_constant_s`.  Measurements that begin
    warm leave a drift that a constant offset takes up.
    """

    name, stage = "joint_drift", "transmission"
    formats = ("rigid", "elastic")
    entry = JointMotion()
    unknowns = (ParameterSpec("drift", MOTION, 0.0, 1e-4),)


class EncoderJump(Jump):
    """δq = d for t ≥ T: the joint's reference jumps by d (rad or m) at T = `jump_time_s`.

    A belt that skips a tooth, a coupling that slips, an encoder that loses counts or is
    referenced anew in the middle of a campaign.
    """

    name, stage = "encoder_jump", "transmission"
    formats = ("rigid", "elastic")
    entry = JointMotion()
    unknowns = (ParameterSpec("jump", MOTION, 0.0, 1e-4),)


class BaseDrift(WarmUp):
    """The base moves by d (1 − exp(−t/T)), d = (drift_x … drift_rz) in m and rad.

    Along the axes of the tracker frame and about the base's origin; T is `time_constant_s`.  A
    pedestal that warms up or settles on its grout, or a tracker whose tripod does the same: only
    fixed reflectors beside the arm can tell the two apart.
    """

    name, stage = "base_drift", "tracker"
    remedy = MEASURE_MONUMENTS
    entry = BaseMotion()
    unknowns = pose_change("drift", 5e-5)


class FrameJump(Jump):
    """The base, as the tracker sees it, moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`.

    In m and rad, along the axes of the tracker frame and about the base's origin.  Somebody
    touches the tripod, or the instrument is set up anew and located with an error: every reading
    after T moves rigidly.
    """

    name, stage, at = "frame_jump", "tracker", "tracker"
    remedy = MEASURE_MONUMENTS
    entry = BaseMotion()
    unknowns = pose_change("jump", 1e-4)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return ("base",)


class LinkJump(Jump):
    """The next joint's frame moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`, along its axes.

    In m and rad.  A collision bends the link; what turns a joint alone is an `encoder_jump`.
    """

    name, stage, at = "link_jump", "geometry", "links"
    formats = ("rigid", "elastic")
    entry = LinkFrame()
    unknowns = pose_change("jump", 1e-4)
    special_cases = (EncoderJump.name,)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return links(chain)[:-1]


class ToolJump(Jump):
    """The flange with all markers moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`.

    In m and rad, along its axes.  A tool is struck or mounted anew; another tool, with its markers
    elsewhere, is this and slips of markers.
    """

    name, stage, at = "tool_jump", "tool", "tool"
    entry = LinkFrame()
    unknowns = pose_change("jump", 1e-3, 5e-4)
    special_cases = (EncoderJump.name,)
    of_the_measurement = True

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        # What a single marker does is a slip, but for its orientation.
        return (self.at,) * (len(cell.tool.markers) > 1 or cell.model.observe == "pose")

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return links(chain)[-1:]


class MarkerSlip(Jump):
    """One marker moves by (slip_x, slip_y, slip_z) in the flange frame for t ≥ T = `slip_time_s`.

    In m.  A reflector that was taken off its magnetic nest and put back, glue that gives way.
    """

    name, stage = "marker_slip", "tool"
    constants = (replace(JUMP_TIME, key="slip_time_s"),)
    entry = MarkerMotion()
    unknowns = tuple(ParameterSpec(f"slip_{k}", "m", 0.0, 1.5e-4) for k in "xyz")
    of_the_measurement = True  # the marker slipped during one campaign


REFERENCE_C = 20.0  # ISO 1: lengths are stated at this temperature


class ThermalExpansion(WarmUp):
    """Lengths of a link (or of all alike: place "all") ← (1 + ε) times themselves.

    ε = e (1 − exp(−t/T)) with the strain e at full warm-up (1) and the time constant T =
    `time_constant_s`; or, with `[model] thermal_driver = "temperature"`, ε = α (T_row − 20 °C)
    with the expansion coefficient α in 1/K (steel 12e-6, aluminium 23e-6) and the table's
    temperature.  Motors and gears heat the castings: 8 K make 0.1 mm per metre of steel.
    """

    name, stage = "thermal_expansion", "geometry"
    formats = ("rigid", "elastic")
    entry = LinkLength()

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return (cell.model.thermal_driver,)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        pairs = zip(links(chain), chain.lengths, strict=True)
        long = (link for link, length in pairs if length > SHORTEST)
        return (*long, "all")

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        if cell.model.thermal_driver == "temperature":
            return (ParameterSpec("expansion", "1/K", 0.0, 12e-6),)
        return (ParameterSpec("expansion", "1", 0.0, 1e-4),)

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        return () if cell.model.thermal_driver == "temperature" else (TIME_CONSTANT,)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return links(chain) if place == "all" else (place,)

    def course(self, arm: Arm, p: Symbols) -> ca.SX:
        if arm.cell.model.thermal_driver == "temperature":
            return arm.input("temperature", 1) - REFERENCE_C
        return super().course(arm, p)

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        return ca.repmat(super().drive(arm, place, p), len(self.entered_at(place, arm.chain)))


class JointOffset(Effect):
    """δq = a: the joint's zero differs from nominal by a (rad, or m for a prismatic joint)."""

    name, stage, at = "joint_offset", "transmission", "joints"
    rank = OFFSET
    formats = ("rigid", "elastic")
    unknowns = (ParameterSpec("offset", MOTION, 0.0, 1e-3),)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.q[index(place)] += p["offset"]


class EncoderScale(DrivenEffect):
    """δq = a·q with the commanded joint value q; a is dimensionless."""

    name, stage, any_size = "encoder_scale", "transmission", True
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

    name, stage, at = "gear_spectrum", "transmission", "turning joints"
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

    name, stage, any_size = "wrist_coupling", "transmission", True
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
        a, b, c = (p[spec.key] for spec in self.unknowns)
        return ca.vertcat(a * first, b * first + c * second)


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


def magnitude(tau: ca.SX, scale: float) -> ca.SX:
    """|τ|, smooth within `scale` of zero."""
    return ca.sqrt(tau**2 + scale**2) - scale


class Backlash(TorqueEffect):
    """δq = (β/2) tanh(τ/τ_s): the joint rests at the end of its play that the load τ drives it to.

    β in rad is the whole play.  tanh is sgn with the dead zone |τ| < τ_s in which friction and
    the balance of the teeth leave the joint between both flanks: a thousandth of its rated torque.
    Where the table says from which side a joint came ([model] play_side = "load_and_approach"),
    δq = (β/2) tanh((τ − a τ_f)/τ_s): a load below the friction τ_f = 3 τ_s does not turn the
    teeth, and the joint lags behind its last motion a = ±1.  τ is the torque of all loads that the
    model has; where the links' weights decide the side, switch `link_gravity` on.
    """

    name, stage, at = "backlash", "transmission", "turning joints"
    unknowns = (ParameterSpec("backlash", "rad", 0.0, 2e-4, lower=0.0),)

    def needed(self, cell: Cell) -> tuple[str, ...]:
        sided = cell.model.play_side == "load_and_approach" and cell.model.approach != BY_ORDER
        return (*super().needed(cell), "approach") if sided else super().needed(cell)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        i = index(place)
        scale, sided = torque_scale(arm.chain, arm.cell, i), arm.cell.model.play_side != "load"
        held = FRICTION * scale * came_from(arm)[i] if sided else 0.0

        def law(tau: ca.SX) -> ca.SX:
            return p["backlash"] / 2 * ca.tanh((tau - held) / scale)

        add_deflection(arm, i, f"{place}.backlash", law)


class Hysteresis(Effect):
    """δq = a (h + g |τ|), a = ±1 the direction of the joint's last motion.

    h in rad, g in rad/(N m).  Dry friction behind the encoder keeps the drive train wound up
    after it stops; friction grows with the load τ on the teeth and bearings, hence g.  |τ| is
    smooth: √(τ² + τ_s²) − τ_s with τ_s a thousandth of the joint's rated torque.
    """

    name, stage, at = "hysteresis", "transmission", "turning joints"
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
        scale, direction = torque_scale(arm.chain, arm.cell, i), came_from(arm)[i]

        def law(tau: ca.SX) -> ca.SX:
            growth = p["hysteresis_per_torque"] * magnitude(tau, scale)
            return direction * (p["hysteresis"] + growth)

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

    name, stage, at = "move_lag", "transmission", "turning joints"
    family = "move"
    entry = JointMotion()
    unknowns = (
        ParameterSpec("move_lag", "rad", 0.0, 1e-4),
        ParameterSpec("move_lag_sign", "rad", 0.0, 5e-5),
        ParameterSpec("move_lag_first", "rad", 0.0, 5e-5),
    )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        i, n = index(place), arm.chain.n_joints
        move, first = arm.input("move", n), arm.input("unmoved", n)
        longest = ca.mmax(ca.fabs(move)) + NEVER
        moved = p["move_lag"] * move[i] / longest + p["move_lag_sign"] * ca.sign(move[i])
        return moved + p["move_lag_first"] * first[i]


class MoveHysteresis(DrivenEffect):
    """δq_j = b sgn Δq_j, Δq_j the last motion of the joint itself; b in rad.

    `Hysteresis` that does not grow with the load, for tables without `approach`: from which side
    the joint came is taken from the order of the visits, with the assumption that `MoveLag` makes.
    Until the joint has moved it has an error of its own.
    """

    name, stage, at = "move_hysteresis", "transmission", "turning joints"
    unless = "approach"
    family = "move"
    entry = JointMotion()
    unknowns = (
        ParameterSpec("move_hysteresis", "rad", 0.0, 5e-5),
        ParameterSpec("move_hysteresis_first", "rad", 0.0, 5e-5),
    )

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        i, n = index(place), arm.chain.n_joints
        side, first = arm.input("direction", n)[i], arm.input("unmoved", n)[i]
        return p["move_hysteresis"] * side + p["move_hysteresis_first"] * first
