"""The chain under construction: parameters, what effects change, and what a table row brings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.cell import Cell
from elastocal.measurements import LARGEST_FORCE, Measurements, by_rows, with_moves
from elastocal.messages import InputError, option
from elastocal.model import rigid
from elastocal.model.chain import Chain, joint_index
from elastocal.units import Array


@dataclass(frozen=True)
class ParameterSpec:
    """A parameter as its effect declares it, before it has a place.

    `typical` is the size one expects of the deviation from nominal; columns of B
    are scaled by it before any rank is judged, so that metres and rad/(N m) compare.
    None means that no size is known beforehand (a compliance without a nominal value):
    `Model.sizes` then finds one from what moves the readings.

    A `shrunk` parameter is one of many that a smooth function or a family of lines consists of:
    it has the prior N(nominal, typical²), which every fit counts.  Those `alike` by the same word
    are of similar sizes, in typical ones.
    """

    key: str
    unit: str
    nominal: float
    typical: float | None
    lower: float = -np.inf
    upper: float = np.inf
    shrunk: bool = False
    alike: str = ""


@dataclass(frozen=True)
class Setting:
    """A constant inside an effect's expression that is set, not fitted: an order, a time.

    The amplitude of the effect vanishes at nominal, and with it every derivative with respect to
    such a constant, so a fit cannot find it; a search over `lower` to `upper` can.  The value
    comes from `[model.nominal.settings.PLACE]`, else `default`; None: there is none, and the
    model asks for it.  `key` carries the unit, as table columns do ("jump_time_s").

    `kind` says which values a diagnosis tries: "order" periods in one turn of the joint,
    "change_time" moments between two visits, "time_constant" some that the campaign can tell
    apart, "range" values at equal distances from `lower` to `upper`, which are finite then.
    """

    key: str
    kind: Literal["order", "change_time", "time_constant", "range"]
    default: float | None
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True)
class Parameter(ParameterSpec):
    """A parameter of the model, at its place: `name` is "joint2.compliance".

    Examples:
        >>> parameter = ec.Model("cell.toml").parameters[0]
        >>> parameter.name, parameter.where, parameter.unit
        ('joint1.compliance', 'joint1', 'rad/(N*m)')
    """

    name: str
    effect: str
    where: str

    def beyond(self, interval: tuple[float, float]) -> bool:
        """Whether all of an interval lies beyond a physical bound."""
        return interval[1] < self.lower or interval[0] > self.upper


# What a parameter of unknown typical size moves the readings by, rms in m.
UNSIZED_SIGNAL = 2e-4


def usual_sizes(specs: Sequence[ParameterSpec], columns: Array) -> Array:
    """Prior standard deviation (k,) of each parameter: its typical size.

    Where none is known, the value whose signal in the columns (…, k) is UNSIZED_SIGNAL rms.
    """
    flat = columns.reshape(-1, columns.shape[-1])
    moved = flat[np.abs(flat).max(axis=1, initial=0.0) > 0]
    rms = np.sqrt((moved**2).mean(axis=0)) if len(moved) else np.zeros(flat.shape[1])
    signal = np.divide(UNSIZED_SIGNAL, rms, out=np.zeros(len(rms)), where=rms > 0)
    return np.array(
        [s if p.typical is None else p.typical for s, p in zip(signal, specs, strict=True)]
    )


# The chain under construction: what effects change, and how it is put together.
#
#     commanded joints → transmission → links → loads → compliance → tool/markers → tracker
#
# All fields are CasADi expressions in the arm's inputs (what the table says of one row), its
# parameters and the elastic deflections θ.  Positions and forces are in the data's frame
# (tracker frame, z vertical).


@dataclass(frozen=True, eq=False)  # a key, whatever its axis and law are made of
class Spring:
    """One elastic degree of freedom: a small joint inserted into the chain.

    `site` is "base" (between base frame and joint 1's placement), "jointN" (just before joint
    N moves, fixed to the proximal link) or "linkN" (at link N's distal end); `kind` and `axis`
    as for a joint, in the frame of the site.  `law` gives the deflection as a function of the
    generalised force that the loads exert on it: θ = law(τ).
    """

    name: str
    site: str
    kind: str
    axis: tuple[float, float, float]
    law: Callable[[ca.SX], ca.SX]

    @classmethod
    def linear(cls, name: str, site: str, kind: str, axis: Any, compliance: ca.SX) -> Spring:
        """A spring with θ = k τ, k in rad/(N m) or m/N."""
        x, y, z = (float(a) for a in axis)
        return cls(name, site, kind, (x, y, z), lambda tau: compliance * tau)


class Arm:
    """Builder handed from effect to effect; `assemble` turns its pieces into positions."""

    def __init__(self, chain: Chain, cell: Cell) -> None:
        n = chain.n_joints
        self.chain, self.cell = chain, cell
        self.inputs: dict[str, ca.SX] = {}
        self.q_commanded = self.input("q", n)
        self.q = [self.q_commanded[i] for i in range(n)]
        self.links = [rigid.constant(T) for T in chain.link_ends]
        nominal = cell.model.nominal
        self.T_tracker_base = rigid.transform(
            None if nominal.base_rotation is None else rigid.constant(nominal.base_rotation),
            None if nominal.base_position is None else rigid.constant(nominal.base_position),
        )
        self.markers = {
            name: rigid.constant(position) for name, position in cell.tool.markers.items()
        }
        self.load_point = rigid.constant(cell.tool.load_point)
        self.marker_rotation = {name: ca.SX.eye(3) for name in self.markers}
        anchor = cell.tracker.anchor
        self.anchor = ca.SX.zeros(3) if anchor is None else rigid.constant(anchor)
        self.length_offset = ca.SX(0)
        self.springs: list[Spring] = []
        self.potential = ca.SX(0)
        self.theta = ca.SX.zeros(0, 1)
        self.T_tracker_link: list[ca.SX] = []
        self.T_tracker_flange = ca.SX.eye(4)
        self.reading: dict[str, ca.SX] = {}

    def input(self, name: str, size: int) -> ca.SX:
        """The row's value of a table quantity ("q", "force", "time", …), declared on first use."""
        if name not in self.inputs:
            self.inputs[name] = ca.SX.sym(name, size)
        return self.inputs[name]

    def add_spring(self, spring: Spring) -> None:
        self.springs.append(spring)

    def add_force(self, point: ca.SX, force: Any) -> None:
        """Dead force (3,) N at a point (3,) that moves with the arm: V = −f·p."""
        self.potential -= ca.dot(ca.SX(force), point)

    def add_potential(self, potential: ca.SX) -> None:
        """Potential energy in J of a conservative load."""
        self.potential += potential

    def joint_angle(self, i: int) -> ca.SX:
        """Joint i's angle (0-based) with the deflection of its own springs about its axis."""
        axis = tuple(float(a) for a in self.chain.joints[i].axis)
        own = [
            self.theta[k]
            for k, s in enumerate(self.springs)
            if s.site == f"joint{i + 1}" and s.axis == axis
        ]
        return self.q[i] + sum(own)

    def assemble(self) -> None:
        """Compose base, springs, joints and links into frames and marker positions."""
        self.theta = ca.SX.sym("theta", len(self.springs))
        T = self.T_tracker_base @ self._deflection("base")
        T = T @ rigid.constant(self.chain.joints[0].placement)
        for i, joint in enumerate(self.chain.joints):
            motion = rigid.joint_motion(joint.kind, joint.axis, self.q[i])
            T = T @ self._deflection(f"joint{i + 1}") @ motion
            self.T_tracker_link.append(T)
            T = T @ self.links[i] @ self._deflection(f"link{i + 1}")
        self.T_tracker_flange = T
        chosen = self._one_hot_sum(self.markers)
        self.reading["position"] = rigid.point(T, chosen)
        reach = self.reading["position"] - self.anchor
        self.reading["distance"] = ca.sqrt(ca.sumsqr(reach)) + self.length_offset
        self.reading["rotation"] = T[:3, :3] @ self._one_hot_sum(self.marker_rotation)

    def _deflection(self, site: str) -> ca.SX:
        T = ca.SX.eye(4)
        for k, spring in enumerate(self.springs):
            if spring.site == site:
                T = T @ rigid.joint_motion(spring.kind, spring.axis, self.theta[k])
        return T

    def _one_hot_sum(self, choices: dict[str, ca.SX]) -> ca.SX:
        # One marker per row: the table's marker enters as a 0/1 input per name.
        if len(choices) == 1:
            return next(iter(choices.values()))
        chosen = self.input("marker", len(choices))
        return sum((chosen[k] * value for k, value in enumerate(choices.values())), ca.SX(0))


# What the symbolic arm asks of a table row, as arrays.

COLUMNS = {
    "q": "q1_deg …",
    "force": "force_x_N …",
    "torque": "torque_1_Nm …",
    "rotation": "rx_deg … or qw …",
    "time": "time_s or time_min",
    "approach": "approach_1 …",
    "temperature": "temperature_C",
    "move": "q1_deg …",
    "direction": "q1_deg …",
}
# A row belongs to a level of a split joint when it is this close to it (rad or m).
LEVEL_TOLERANCE = 0.01


def row_inputs(arm: Arm, table: Measurements) -> list[NDArray]:
    """One (n, size) array per input the arm declared, in its order."""
    known = list(arm.markers)
    strange = {table.marker_names[k] for k in np.unique(table.marker)} - set(known)
    if strange:
        raise InputError(
            f"{table.source}: marker '{min(strange)}' is not one of the cell's markers: "
            f"{', '.join(known)}"
        )
    return [_one(arm, table, name) for name in arm.inputs]


def _one(arm: Arm, table: Measurements, name: str) -> NDArray:
    if name == "marker":
        known = {marker: k for k, marker in enumerate(arm.markers)}
        codes = np.array([known.get(marker, 0) for marker in table.marker_names])
        return np.eye(len(known))[codes[table.marker]]
    if name.startswith("level:"):
        joint = name.removeprefix("level:")
        levels, q = arm.cell.model.compliance_levels[joint], table.q[:, joint_index(joint)]
        distance = np.abs(q[:, None] - np.array(levels))
        for i in np.flatnonzero(distance.min(axis=1) > LEVEL_TOLERANCE)[:1]:
            raise InputError(
                f"{table.source}, line {table.row[i]}: {joint} stands at "
                f"{np.degrees(q[i]):.3f}°, which is none of its levels in "
                "[model.compliance_levels]; add the level or drop the row"
            )
        return np.eye(len(levels))[distance.argmin(axis=1)]
    if name == "unmoved":
        known_moves = np.ones_like(table.q) if table.direction is None else table.direction
        return (known_moves == 0).astype(np.float64)
    if name in ("move", "direction") and getattr(table, name) is None:
        table = with_moves(table)
    value = getattr(table, name)
    if name == "time" and value is None and arm.cell.model.clock == "rows":
        value = by_rows(table)
    if value is None:
        raise InputError(
            f"{table.source}: the model needs the column {COLUMNS[name]}, which the table lacks"
        )
    return value[:, None] if value.ndim == 1 else value


def given_force(load: ArrayLike | None, poses: int | None = None) -> Array | None:
    """The option `load` as a force (3,) in N, or one for each of so many `poses` (poses, 3); None
    where it is not given."""
    if load is None:
        return None
    force = np.asarray(load, dtype=float)
    known = force.shape == (3,) or force.shape == (poses, 3)
    if known and (np.abs(force) <= LARGEST_FORCE).all():
        return force
    if poses is None:
        found = " ".join(f"{v:g}" for v in force) if force.ndim == 1 and len(force) else load
        most = "" if not np.isfinite(force).all() else f" of at most {LARGEST_FORCE:g}"
        raise InputError(f"{option('load')} takes three finite numbers in N{most}; found {found}")
    found = "numbers beyond all measure" if known else f"an array of shape {force.shape}"
    raise InputError(
        f"{option('load')} takes a force (3,) in N, or one for each pose ({poses}, 3); found "
        f"{found}"
    )
