"""Where base, links, markers and anchor really stand."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell.work_cell import Cell
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import LINK, MARKER, STATION, Effect, Symbols, index
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
        vector = Rotation.from_matrix(rotation).as_rotvec()
        units = ["m"] * 3 + ["rad"] * 3
        known = zip(KEYS, units, [*position, *vector], strict=True)
        return tuple(ParameterSpec(k, u, float(v), 3e-3) for k, u, v in known)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        position = ca.vertcat(p["x"], p["y"], p["z"])
        vector = ca.vertcat(p["rx"], p["ry"], p["rz"])
        arm.T_tracker_base = rigid.transform(rigid.rotation_from_vector(vector), position)


SHORTEST = 1e-6  # m; a shorter link has neither a length to grow nor a direction of its own


def link_ends(chain: Chain) -> list[Array]:
    """Per link the placement (4, 4) of its distal frame in its joint's frame at zero motion.

    The distal frame is the next joint's, the flange's for the last link.
    """
    return [joint.placement for joint in chain.joints[1:]] + [chain.flange_placement]


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
        i = index(place)
        shift = ca.vertcat(p["dx"], p["dy"], p["dz"])
        turn = rigid.rotation_from_vector(ca.vertcat(p["rx"], p["ry"], p["rz"]))
        arm.links[i] = arm.links[i] @ rigid.transform(turn, shift)


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
    unknowns = tuple(ParameterSpec(k, "rad", 0.0, 3e-3) for k in ("rx", "ry", "rz"))

    def may_be_missing(self, cell: Cell) -> bool:
        return cell.model.observe == "pose"

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
    at = "tracker"
    registered = True
    rank = STATION

    def may_be_missing(self, cell: Cell) -> bool:
        return cell.model.observe == "distance"

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
