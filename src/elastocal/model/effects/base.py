"""The arm under construction, and what every effect on it is: its parameters, its places in the
chain, its expression, its traits."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.cell import Cell
from elastocal.files import REGISTERED, check_registered
from elastocal.measurements import LARGEST_FORCE, Measurements, by_rows, with_moves
from elastocal.messages import InputError, listed, option, require
from elastocal.model import rigid
from elastocal.model.chain import Chain, joint_index
from elastocal.units import Array, pose_at


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

    def __post_init__(self) -> None:
        if not (np.isfinite(self.nominal) and (self.typical is None or 0 < self.typical < np.inf)):
            told = "takes a finite nominal value, and a typical size above 0 or None; found"
            raise ValueError(f"the parameter '{self.key}' {told} {self.nominal}, {self.typical}")


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
        return interval[1] < self.lower or interval[0] > self.upper


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
    axis: tuple[float, ...]
    law: Callable[[ca.SX], ca.SX]

    @classmethod
    def linear(cls, name: str, site: str, kind: str, axis: Any, compliance: ca.SX) -> Spring:
        """A spring with θ = k τ, k in rad/(N m) or m/N."""
        return cls(name, site, kind, tuple(map(float, axis)), lambda tau: compliance * tau)


class Arm:
    """The chain under construction, handed from effect to effect; `assemble` puts it together.

    All fields are CasADi expressions in the arm's `inputs` (what the table says of one row), its
    parameters and the elastic deflections θ.  Positions and forces are in the data's frame
    (tracker frame, z vertical).
    """

    def __init__(self, chain: Chain, cell: Cell) -> None:
        n = chain.n_joints
        self.chain, self.cell = chain, cell
        self.inputs: dict[str, ca.SX] = {}
        self.q_commanded = self.input("q", n)
        self.q = [self.q_commanded[i] for i in range(n)]
        self.links = [rigid.constant(T) for T in chain.link_ends]
        nominal = cell.model.nominal
        at = np.zeros(3) if nominal.base_position is None else nominal.base_position
        self.T_tracker_base = rigid.constant(pose_at(at, nominal.base_rotation))
        self.markers = {name: rigid.constant(at) for name, at in cell.tool.markers.items()}
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
        if name not in (*COLUMNS, "marker", "moment", "unmoved") and not name.startswith("level:"):
            raise ValueError(f"arm.input takes {listed(sorted(COLUMNS), 9)}; found {name!r}")
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
        axis, site = tuple(map(float, self.chain.joints[i].axis)), f"joint{i + 1}"
        own = (k for k, s in enumerate(self.springs) if (s.site, s.axis) == (site, axis))
        return self.q[i] + sum(self.theta[k] for k in own)

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
        self.reading["position"] = rigid.point(T, self._one_hot_sum(self.markers))
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


COLUMNS = {
    "q": "q1_deg …", "force": "force_x_N …", "torque": "torque_1_Nm …",
    "rotation": "rx_deg … or qw …", "time": "time_s or time_min", "approach": "approach_1 …",
    "temperature": "temperature_C", "move": "q1_deg …", "direction": "q1_deg …",
}  # fmt: skip
# A row belongs to a level of a split joint when it is this close to it (rad or m).
LEVEL_TOLERANCE = 0.01


def row_inputs(arm: Arm, table: Measurements, asked: Iterable[str] | None = None) -> list[NDArray]:
    """One (n, size) array for each input that is asked for, by default all that the arm declared,
    in its order."""
    strange = {table.marker_names[k] for k in np.unique(table.marker)} - set(arm.markers)
    told = f"marker '{min(strange, default='')}' is not one of the cell's markers:"
    require(not strange, f"{table.source}: {told} {', '.join(arm.markers)}")
    return [_one(arm, table, name) for name in (arm.inputs if asked is None else asked)]


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
    if name == "moment":  # by which something has changed
        if arm.cell.model.clock == "rows":
            return by_rows(table)[:, None]
        name = "time"
    value = getattr(table, name)
    told = f"the model needs the column {COLUMNS[name]}, which the table lacks"
    require(value is not None, f"{table.source}: {told}")
    return np.asarray(value[:, None] if value.ndim == 1 else value)


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
    told = f"takes a force (3,) in N, or one for each pose ({poses}, 3); found {found}"
    raise InputError(f"{option('load')} {told}")


Stage = Literal["transmission", "geometry", "load", "compliance", "tool", "tracker"]
# Kinds of file that can hold an effect: of a rigid arm (URDF, DH table), or with springs (MJCF).
Format = Literal["rigid", "elastic"]
Symbols = Mapping[str, ca.SX]
NEEDS = ("time", "approach", "temperature", "load", "torque")
MOTION = "rad or m"  # unit of a parameter of a joint's motion, as the joint turns or slides

# Ranks of parameters: where a choice is free, a minimal complete set takes low ones first.
STIFFNESS, STATION, MARKER, OFFSET, ORDINARY, LINK = range(6)
# Units of a motion along and about the axes of a frame.
MOVE = ("m", "m", "m", "rad", "rad", "rad")


class Effect:
    """One physical effect on the chain.  It knows nothing about estimation.

    A subclass states `name` and `stage`, the places where it can act, the
    parameters it has at a place, and overrides the one method its stage calls for:

    - `shape`: changes joint motion, link transforms, springs, markers, base frame;
      called before the chain is put together.
    - `load`: adds forces or potentials; called when every point's position is known
      as a function of the elastic deflections.
    - `read`: changes what the instrument reports; called last.

    Parameter symbols arrive as a mapping from the keys of `parameters` and `settings` to CasADi
    scalars.

    The traits say what other parts of the toolkit ask of an effect, so that none of them lists
    effects by name.  Their defaults suit an effect of which nothing more is known.

    Examples:
        >>> from elastocal.model.effects.catalogue import CATALOGUE
        >>> backlash = CATALOGUE["backlash"]
        >>> isinstance(backlash, ec.Effect), backlash.stage
        (True, 'transmission')
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    # Where it acts, unless `places` says more: at all "joints", "turning joints", "links" or
    # "markers", or at the one place of this name.
    at: ClassVar[str] = ""
    # Its settings, unless `settings` says more.
    constants: ClassVar[tuple[Setting, ...]] = ()
    # Its parameters, unless `parameters` says more.
    unknowns: ClassVar[tuple[ParameterSpec, ...]] = ()
    # What the table must say for the effect to show, of NEEDS.
    needs: ClassVar[tuple[str, ...]] = ()

    # Traits.
    # Found by placing the nominal arm on the readings: base, markers, anchor.  It belongs to the
    # set-up, so plans and diagnoses do not count it as an error of the arm.
    registered: ClassVar[bool] = False
    # A linear compliance: without a load it deflects nothing.
    elastic: ClassVar[bool] = False
    # `typical` is the size of the value itself, not that of its deviation from nominal.
    sized_by_value: ClassVar[bool] = False
    # Its place in the choice of a minimal complete set, STIFFNESS to LINK.
    rank: ClassVar[int] = ORDINARY
    # The kinds of file that can hold it; what none can hold is exported as an error with its cost.
    formats: ClassVar[tuple[Format, ...]] = ()
    # One of many causes at once: a diagnosis judges it only in the sum of all components.
    together: ClassVar[bool] = False
    # The one kind of reading that shows it.
    seen_in: ClassVar[str] = ""
    # It corrects the arm and names no cause.
    nameless: ClassVar[bool] = False
    # A column of the table that says better what it takes from elsewhere.
    unless: ClassVar[str] = ""
    # The setting that is the prior size of its shrunk parameters.
    sized_by: ClassVar[str] = ""
    # What it depends on in the first place, where its stage and needs do not say so.
    family: ClassVar[str] = ""
    # Effects that it comes down to where few of its parameters act: those then are the cause.
    special_cases: ClassVar[tuple[str, ...]] = ()
    # How many times its typical size it may be at most: beyond, it is something else.
    most: ClassVar[float] = 1000.0
    # Beyond what is typical it may be of any size: a ratio of the controller that is wrong, an
    # instrument that was set up anew.
    any_size: ClassVar[bool] = False
    # What to measure besides more poses where those do not tell it from other effects.
    remedy: ClassVar[str] = ""

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        """Every place where this effect makes sense on this arm, e.g. ("joint1", …)."""
        known = {
            "joints": joints, "turning joints": turning_joints, "links": links,
            "markers": lambda _: tuple(f"marker:{name}" for name in cell.tool.markers),
        }  # fmt: skip
        return known[self.at](chain) if self.at in known else (self.at,)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        """The parameters at one place; loads may have none."""
        shrunk = self.shrunk_keys(place, chain)
        size = self.stated(place, chain, cell)[self.sized_by] if shrunk else 0.0
        return (
            *(replace(p, unit=motion_unit(place, chain)) if p.unit == MOTION else p
              for p in self.unknowns),
            *(ParameterSpec(key, unit, 0.0, size, shrunk=True) for key, unit in shrunk.items()),
        )  # fmt: skip

    def shrunk_keys(self, place: str, chain: Chain) -> dict[str, str]:
        """Keys of its shrunk parameters of the one size that `sized_by` states → units."""
        return {}

    def starts(self, place: str, chain: Chain, cell: Cell) -> tuple[dict[str, float], ...]:
        """Values of some parameters from which to look for the others, where nominal ones say
        nothing about this arm."""
        return ()

    def profiles(self, place: str, starts: Sequence[Mapping[str, float]], q: Array) -> Array | None:
        """(n, starts): the torque about the joint where it acts, for each unit of its first
        parameter, at the joints' values q (n, joints) about each of some starts.  None where only
        the whole model says; with profiles many starts cost little."""
        return None

    def hints(self, place: str, values: Mapping[str, float]) -> dict[str, Any]:
        """Keys of [model.nominal] from which a fit of this effect finds `values` (by key) again;
        none where it does so from nominal."""
        return {}

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        """Constants of the expression at one place that are set or searched, not fitted."""
        return self.constants

    def stated(self, place: str, chain: Chain, cell: Cell) -> dict[str, float]:
        """The values of its settings at a place by key: the cell's, else the default, else 0."""
        given = cell.model.nominal.settings.get(place, {})
        settings = self.settings(place, chain, cell)
        return {s.key: float(given.get(s.key, s.default or 0.0)) for s in settings}

    def functions(self, place: str, chain: Chain, cell: Cell) -> tuple[Any, ...]:
        """Each `SmoothFunction` that shrunk parameters at one place make up."""
        return ()

    def lasting(self, cell: Cell) -> Cell:
        """The cell without what of this effect belongs to one campaign and not to the arm."""
        return cell

    def needed(self, cell: Cell) -> tuple[str, ...]:
        """`needs` for this cell: what shows an effect may depend on the model around it."""
        return self.needs

    @property
    def of_the_measurement(self) -> bool:
        """Whether it belongs to one campaign and its instrument, and is no part of the arm."""
        return self.stage == "tracker"

    def acts_unasked(self, cell: Cell) -> bool:
        """Whether it acts though `[model] effects` does not list it."""
        return False

    def may_be_missing(self, cell: Cell) -> bool:
        """Whether a diagnosis of this cell's data may suspect it by itself."""
        return not self.together and self.seen_in in ("", cell.model.observe)

    def acts(self, place: str, chain: Chain, cell: Cell) -> bool:
        """Whether it moves anything at this place of an arm that is mounted as the cell says."""
        return True

    def unphysical(self, values: Mapping[str, float], chain: Chain, cell: Cell) -> str:
        """Why no spring or body has these `values` (by parameter name); "" where one may."""
        return ""

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        """Change the pieces of the chain before it is assembled."""

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        """Add forces or potentials once points are known."""

    def read(self, arm: Arm, place: str, p: Symbols) -> None:
        """Change the instrument's reading."""


AT = (
    "joints", "turning joints", "links", "markers", "jointN", "linkN", "marker:NAME", "base",
    "wrist", "tool", "load", "tracker", "arm", "all", "",
)  # fmt: skip


def check(effect: object) -> None:
    """InputError where `effect` cannot stand in the catalogue, and what it lacks."""
    check_registered(effect, Effect, "an effect", "joint_offset")
    assert isinstance(effect, Effect)
    kind = type(effect)
    for key, given, known in (
        ("stage", (getattr(effect, "stage", None),), get_args(Stage)),
        ("at", (re.sub("[1-9][0-9]*$", "N", re.sub(":.+", ":NAME", effect.at)),), AT),
        ("formats", effect.formats, get_args(Format)),
        ("needs", effect.needs, NEEDS),
    ):
        for found in given:
            require(
                found in known, f"{kind.__name__}.{key} takes {listed(known, 14)}; found {found!r}"
            )
    hooks = ("shape", "load", "read")
    lacking = [] if kind.places is not Effect.places or kind.at else ["places"]
    lacking += [] if any(getattr(kind, h) is not getattr(Effect, h) for h in hooks) else ["a hook"]
    told = f"{kind.__name__} lacks {' and '.join(lacking)}; it states where it can act (places) and"
    require(not lacking, f"{told} what it does there ({listed(hooks)})")


def joints(chain: Chain) -> tuple[str, ...]:
    """Places "joint1" … "jointN"."""
    return tuple(f"joint{i + 1}" for i in range(chain.n_joints))


def turning_joints(chain: Chain) -> tuple[str, ...]:
    """Those of `joints` that are revolute."""
    kinds = zip(joints(chain), chain.kinds, strict=True)
    return tuple(joint for joint, kind in kinds if kind == "revolute")


def motion_unit(place: str, chain: Chain) -> str:
    """Unit of the motion of "jointN": rad, or m where it slides."""
    return "rad" if chain.kinds[index(place)] == "revolute" else "m"


def links(chain: Chain) -> tuple[str, ...]:
    """Places "link1" … "linkN"; link i is the body that joint i moves."""
    return tuple(f"link{i + 1}" for i in range(chain.n_joints))


index = joint_index


SHORTEST = 1e-6  # m; a shorter link has neither a length to grow nor a direction of its own


def transverse_axes(axis: Array) -> tuple[Array, Array]:
    """Two unit axes x, y with x × y = axis; x is the coordinate axis farthest from the joint axis
    that comes first, made orthogonal: the frame's own x and y where the axis is z."""
    start = np.eye(3)[int(np.argmin(np.abs(axis).round(9)))]
    x = start - axis * (axis @ start)
    x /= np.linalg.norm(x)
    return x, np.cross(axis, x)


# Effects that the table drives: small motions, and where along the chain they enter.


class Entry(Effect):
    """A small motion u of `size` components at one place of the chain, in m or rad.

    As an effect of its own its parameters are u itself, the same in every row, so that B holds
    ∂(reading)/∂u; multiplied by what drives u row by row it is the B of a driven effect.
    """

    units: ClassVar[tuple[str, ...]]

    @property
    def size(self) -> int:
        return len(self.units)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        every = enumerate(self.units, start=1)
        return tuple(ParameterSpec(f"{self.name}_{k}", unit, 0.0, 1e-4) for k, unit in every)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        self.enter(arm, place, ca.vertcat(*p.values()))

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        """Add the motion u (size,) to the chain's pieces."""
        raise NotImplementedError


class JointMotion(Entry):
    """q_i ← q_i + u, in rad (m for a prismatic joint)."""

    name, stage, at = "joint_motion", "transmission", "joints"
    units = ("rad",)

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        arm.q[index(place)] += u[0]


class LinkLength(Entry):
    """Lengths of link i ← (1 + u) times themselves: its distal frame moves away from its own."""

    name, stage, at = "link_length", "geometry", "links"
    units = ("1",)

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        i = index(place)
        T = ca.SX(arm.links[i])
        T[:3, 3] *= 1 + u[0]
        arm.links[i] = T


class LinkFrame(Entry):
    """T_link ← T_link · Trans(u₁, u₂, u₃) · exp([u₄, u₅, u₆]×) at the link's distal end."""

    name, stage, at = "link_frame", "geometry", "links"
    units = MOVE

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        i = index(place)
        arm.links[i] = arm.links[i] @ rigid.transform(rigid.rotation_from_vector(u[3:]), u[:3])


class BaseMotion(Entry):
    """The base moves by (u₁, u₂, u₃) and turns by [u₄, u₅, u₆] about its own origin.

    Both along the axes of the tracker frame.
    """

    name, stage, at = "base_motion", "tracker", "base"
    units = MOVE

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        T = arm.T_tracker_base
        turned = rigid.rotation_from_vector(u[3:]) @ T[:3, :3]
        arm.T_tracker_base = rigid.transform(turned, T[:3, 3] + u[:3])


class MarkerMotion(Entry):
    """One marker moves by u (3,) in the flange frame."""

    name, stage, at = "marker_motion", "tool", "markers"
    units = ("m", "m", "m")

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        arm.markers[place.removeprefix("marker:")] += u


class LoadPointMotion(Entry):
    """The point where the load hangs moves by u (3,) in the flange frame."""

    name, stage, at = "load_point_motion", "load", "load"
    units = ("m", "m", "m")

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        arm.load_point += u


class DrivenEffect(Effect):
    """u = D(row) p at an `entry` of the chain: linear in its parameters p.

    The drive D depends on the row (joint angles, time, approach direction) and on the effect's
    settings, not on the arm's deflection.  So B = ∂(reading)/∂u · D, and a search over settings
    evaluates D alone.
    """

    entry: ClassVar[Entry]

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return super().places(chain, cell) if self.at else self.entry.places(chain, cell)

    @abstractmethod
    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        """u of the row, linear in the parameters: (entry.size,) of every entered place, stacked."""

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        """The places of the entry that u acts on, in the order in which u stacks them."""
        return (place,)

    def entry_at(self, place: str) -> Entry:
        """The entry that u acts on, which is another one at some places of few effects."""
        return self.entry

    def motion(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        """`drive`, which of a plug-in need not return what it has to."""
        u = self.drive(arm, place, p)
        if type(self) in REGISTERED:
            shape = (self.entry_at(place).size * len(self.entered_at(place, arm.chain)), 1)
            own = ca.vertcat(*(p[s.key] for s in self.parameters(place, arm.chain, arm.cell)))
            right = isinstance(u, ca.SX) and u.shape == shape and ca.is_linear(u, own)
            if not (right and ca.substitute(u, own, 0 * own).is_zero()):
                told = "linear in the parameters p and zero where they are"
                raise ValueError(f"drive() returns an expression of shape {shape}, {told}")
        return u

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        places, entry = self.entered_at(place, arm.chain), self.entry_at(place)
        motions = ca.vertsplit(self.motion(arm, place, p), entry.size)
        for where, u in zip(places, motions, strict=True):
            entry.enter(arm, where, u)
