"""Where base, links, markers and anchor stand, and how that changes while one measures."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np

from elastocal.cell import Cell
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    LINK,
    MARKER,
    MOTION,
    MOVE,
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
    links,
)
from elastocal.units import Array

KEYS = ("x", "y", "z", "rx", "ry", "rz")


class BaseFrame(Effect):
    """T_tracker_base = Trans(x, y, z) · exp([rx, ry, rz]×), absolute values.

    Position in m, rotation vector in rad, both in the tracker frame.  The rotation vector is
    regular up to a full turn, so the tracker may be turned any way.
    """

    name = "base_frame"
    stage = "tracker"
    at = "base"
    registered = True
    rank = STATION
    formats = ("rigid", "elastic")

    @property
    def of_the_measurement(self) -> bool:
        return False  # where the base stands is the arm's

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


SHORTEST = 1e-6  # m; a shorter link has neither a length to grow nor a direction of its own


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit axes x, y with x × y = axis; the frame's own x and y where the axis is z.

    x is the coordinate axis farthest from the joint axis that comes first, made orthogonal.
    """
    start = np.eye(3)[int(np.argmin(np.abs(axis).round(9)))]
    x = start - axis * (axis @ start)
    x /= np.linalg.norm(x)
    return x, np.cross(axis, x)


class LinkGeometry(Effect):
    """T_link = T_nominal · Trans(dx, dy, dz) · exp([rx, ry, rz]×) at the link's distal end.

    T_nominal takes the next joint's frame (the flange's for the last link) to this link's
    joint frame; the error moves and tilts that next frame, in m and rad, along its own axes.
    Six per link are complete but redundant; identification reduces them to a minimal set
    (Stone 1987; Hollerbach, Khalil and Gautier 2008).
    """

    name = "link_geometry"
    stage = "geometry"
    at = "links"
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

    name = "marker_position"
    stage = "tool"
    at = "markers"
    registered = True
    rank = MARKER
    formats = ("rigid", "elastic")

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.tool.markers[place.removeprefix("marker:")]
        return tuple(
            ParameterSpec(k, "m", float(v), 3e-3) for k, v in zip("xyz", nominal, strict=True)
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        arm.markers[place.removeprefix("marker:")] = ca.vertcat(p["x"], p["y"], p["z"])


class MarkerOrientation(Effect):
    """R_flange_target = exp([rx, ry, rz]×), rotation vector in rad; nominal: as the flange."""

    name = "marker_orientation"
    stage = "tool"
    at = "markers"
    registered = True
    rank = MARKER
    formats = ("rigid", "elastic")
    seen_in = "pose"
    unknowns = tuple(ParameterSpec(k, "rad", 0.0, 3e-3) for k in ("rx", "ry", "rz"))

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        name = place.removeprefix("marker:")
        arm.marker_rotation[name] = rigid.rotation_from_vector(vector)


class DistanceSensor(Effect):
    """reading = |p_marker − p_anchor| + offset; anchor (x, y, z) and offset in m.

    The anchor is in the frame of the data (the robot's base frame unless `base_frame` is fitted
    or given).
    """

    name = "distance_sensor"
    stage = "tracker"
    seen_in = "distance"
    at = "tracker"
    registered = True
    rank = STATION

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        nominal = cell.tracker.anchor if cell.tracker.anchor is not None else np.zeros(3)
        anchor = [
            ParameterSpec(f"anchor_{k}", "m", float(v), 3e-3)
            for k, v in zip("xyz", nominal, strict=True)
        ]
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

    name = "tracker_distortion"
    stage = "tracker"
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


def pose_change(prefix: str, length: float) -> tuple[ParameterSpec, ...]:
    """`prefix`_x … `prefix`_rz with typical sizes `length` in m and 50 µrad."""
    sizes = {"m": length, "rad": 5e-5}
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


class Jump(WarmUp):
    """u = d for t ≥ T, d all parameters of the place and T the one setting, in s: nobody knows
    beforehand when something changed."""

    def course(self, arm: Arm, p: Symbols) -> ca.SX:
        return arm.input("time", 1) >= p[self.constants[0].key]


JUMP_TIME = Setting("jump_time_s", "change_time", None, -np.inf, np.inf)


class JointDrift(WarmUp):
    """δq = d (1 − exp(−t/T)): the joint's reference has moved by d (rad or m) once warm.

    Gears and encoder mounts warm up with the motor beside them and shift the joint's zero; t is
    the table's time from its origin, T the setting `time_constant_s`.  Measurements that begin
    warm leave a drift that a constant offset takes up.
    """

    name = "joint_drift"
    stage = "transmission"
    formats = ("rigid", "elastic")
    entry = JointMotion()
    unknowns = (ParameterSpec("drift", MOTION, 0.0, 1e-4),)


class EncoderJump(Jump):
    """δq = d for t ≥ T: the joint's reference jumps by d (rad or m) at T = `jump_time_s`.

    A belt that skips a tooth, a coupling that slips, an encoder that loses counts or is
    referenced anew in the middle of a campaign.
    """

    name = "encoder_jump"
    stage = "transmission"
    constants = (JUMP_TIME,)
    formats = ("rigid", "elastic")
    entry = JointMotion()
    unknowns = (ParameterSpec("jump", MOTION, 0.0, 1e-4),)


class BaseDrift(WarmUp):
    """The base moves by d (1 − exp(−t/T)), d = (drift_x … drift_rz) in m and rad.

    Along the axes of the tracker frame and about the base's origin; T is `time_constant_s`.  A
    pedestal that warms up or settles on its grout, or a tracker whose tripod does the same: only
    fixed reflectors beside the arm can tell the two apart.
    """

    name = "base_drift"
    stage = "tracker"
    remedy = MEASURE_MONUMENTS
    entry = BaseMotion()
    unknowns = pose_change("drift", 5e-5)


class FrameJump(Jump):
    """The base, as the tracker sees it, moves by (jump_x … jump_rz) for t ≥ T = `jump_time_s`.

    In m and rad, along the axes of the tracker frame and about the base's origin.  Somebody
    touches the tripod, or the instrument is set up anew and located with an error: every reading
    after T moves rigidly.
    """

    name = "frame_jump"
    stage = "tracker"
    at = "tracker"
    constants = (JUMP_TIME,)
    remedy = MEASURE_MONUMENTS
    entry = BaseMotion()
    unknowns = pose_change("jump", 1e-4)

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        return ("base",)


class MarkerSlip(Jump):
    """One marker moves by (slip_x, slip_y, slip_z) in the flange frame for t ≥ T = `slip_time_s`.

    In m.  A reflector that was taken off its magnetic nest and put back, glue that gives way.
    """

    name = "marker_slip"
    stage = "tool"
    constants = (replace(JUMP_TIME, key="slip_time_s"),)
    entry = MarkerMotion()
    unknowns = tuple(ParameterSpec(f"slip_{k}", "m", 0.0, 1.5e-4) for k in "xyz")

    @property
    def of_the_measurement(self) -> bool:
        return True  # the marker slipped during one campaign


REFERENCE_C = 20.0  # ISO 1: lengths are stated at this temperature


class ThermalExpansion(WarmUp):
    """Lengths of a link (or of all alike: place "all") ← (1 + ε) times themselves.

    ε = e (1 − exp(−t/T)) with the strain e at full warm-up (1) and the time constant T =
    `time_constant_s`; or, with `[model] thermal_driver = "temperature"`, ε = α (T_row − 20 °C)
    with the expansion coefficient α in 1/K (steel 12e-6, aluminium 23e-6) and the table's
    temperature.  Motors and gears heat the castings: 8 K make 0.1 mm per metre of steel.
    """

    name = "thermal_expansion"
    stage = "geometry"
    formats = ("rigid", "elastic")
    entry = LinkLength()

    def needed(self, cell: Cell) -> tuple[str, ...]:
        return (cell.model.thermal_driver,)

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        lengths = [np.linalg.norm(T[:3, 3]) for T in chain.link_ends]
        long = [link for link, m in zip(links(chain), lengths, strict=True) if m > SHORTEST]
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
