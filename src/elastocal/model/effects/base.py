"""What every effect is: its parameters, its places in the chain, its expression, its traits."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, get_args

import casadi as ca

from elastocal.cell import Cell
from elastocal.messages import InputError, listed, require
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec, Setting
from elastocal.model.chain import Chain, joint_index
from elastocal.plugin_loader import check_registered
from elastocal.units import Array

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

FULL_TURN = 0.98  # of 2π: a range from which on a joint's curve is periodic


@dataclass(frozen=True)
class SmoothFunction:
    """What shrunk parameters of an effect make up: a smooth function of one quantity of a row.

    `follows` is a joint, "joint2", or "time"; `keys` (components, waves) are its parameters and
    `units` (components,) those of its values.  `size` and `length` are the standard deviation and
    the correlation length of its prior; between `low` and `high` it was measured (rad or s).
    `basis` gives the waves (n, waves) at values (n,) of what it follows.
    """

    follows: str
    keys: tuple[tuple[str, ...], ...]
    units: tuple[str, ...]
    size: float
    length: float = math.nan
    low: float = math.nan
    high: float = math.nan
    basis: Callable[[Array], Array] | None = None

    @property
    def lasting(self) -> bool:
        """Whether it belongs to the arm, and not to the time of one campaign."""
        return self.follows != "time"

    @property
    def whole_turn(self) -> bool:
        """Whether it was measured all the way round, so that no angle lies outside."""
        return self.lasting and self.high - self.low >= FULL_TURN * 2 * math.pi


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
    # How many times its typical size it may be at most: beyond, it is something else.
    most: ClassVar[float] = 1000.0
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
        """(n, starts): how the first parameter's columns depend on the joints q (n, joints) about
        each of some starts, but for a factor of the row that all starts share.  None where only
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

    def functions(self, place: str, chain: Chain, cell: Cell) -> tuple[SmoothFunction, ...]:
        """The smooth functions that its shrunk parameters at one place make up, if they do."""
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


def check(effect: object) -> None:
    """InputError where `effect` cannot stand in the catalogue, and what it lacks."""
    check_registered(effect, Effect, "an effect", "joint_offset")
    assert isinstance(effect, Effect)
    kind = type(effect)
    for key, given, known in (
        ("stage", (getattr(effect, "stage", None),), get_args(Stage)),
        ("formats", effect.formats, get_args(Format)),
        ("needs", effect.needs, NEEDS),
    ):
        for found in given:
            told = f"{kind.__name__}.{key} takes {listed(known)}; found {found!r}"
            require(found in known, told)
    hooks = ("shape", "load", "read")
    lacking = [] if kind.places is not Effect.places or kind.at else ["places"]
    lacking += [] if any(getattr(kind, h) is not getattr(Effect, h) for h in hooks) else ["a hook"]
    if lacking:
        raise InputError(
            f"{kind.__name__} lacks {' and '.join(lacking)}; it states where it can act (places) "
            f"and what it does there ({listed(hooks)})"
        )


def joints(chain: Chain) -> tuple[str, ...]:
    """Places "joint1" … "jointN"."""
    return tuple(f"joint{i + 1}" for i in range(chain.n_joints))


def turning_joints(chain: Chain) -> tuple[str, ...]:
    """Those of `joints` that are revolute."""
    return tuple(
        j for j, kind in zip(joints(chain), chain.kinds, strict=True) if kind == "revolute"
    )


def motion_unit(place: str, chain: Chain) -> str:
    """Unit of the motion of "jointN": rad, or m where it slides."""
    return "rad" if chain.kinds[index(place)] == "revolute" else "m"


def links(chain: Chain) -> tuple[str, ...]:
    """Places "link1" … "linkN"; link i is the body that joint i moves."""
    return tuple(f"link{i + 1}" for i in range(chain.n_joints))


index = joint_index


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
        return tuple(
            ParameterSpec(f"{self.name}_{k + 1}", unit, 0.0, 1e-4)
            for k, unit in enumerate(self.units)
        )

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        self.enter(arm, place, ca.vertcat(*[p[f"{self.name}_{k + 1}"] for k in range(self.size)]))

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        """Add the motion u (size,) to the chain's pieces."""
        raise NotImplementedError


class JointMotion(Entry):
    """q_i ← q_i + u, in rad (m for a prismatic joint)."""

    name = "joint_motion"
    stage: ClassVar[Stage] = "transmission"
    at = "joints"
    units = ("rad",)

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        arm.q[index(place)] += u[0]


class LinkLength(Entry):
    """Lengths of link i ← (1 + u) times themselves: its distal frame moves away from its own."""

    name = "link_length"
    stage: ClassVar[Stage] = "geometry"
    at = "links"
    units = ("1",)

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        i = index(place)
        T = ca.SX(arm.links[i])
        T[:3, 3] *= 1 + u[0]
        arm.links[i] = T


class LinkFrame(Entry):
    """T_link ← T_link · Trans(u₁, u₂, u₃) · exp([u₄, u₅, u₆]×) at the link's distal end."""

    name = "link_frame"
    stage: ClassVar[Stage] = "geometry"
    at = "links"
    units = MOVE

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        i = index(place)
        arm.links[i] = arm.links[i] @ rigid.transform(rigid.rotation_from_vector(u[3:]), u[:3])


class BaseMotion(Entry):
    """The base moves by (u₁, u₂, u₃) and turns by [u₄, u₅, u₆] about its own origin.

    Both along the axes of the tracker frame.
    """

    name = "base_motion"
    stage: ClassVar[Stage] = "tracker"
    at = "base"
    units = MOVE

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        T = arm.T_tracker_base
        turned = rigid.rotation_from_vector(u[3:]) @ T[:3, :3]
        arm.T_tracker_base = rigid.transform(turned, T[:3, 3] + u[:3])


class MarkerMotion(Entry):
    """One marker moves by u (3,) in the flange frame."""

    name = "marker_motion"
    stage: ClassVar[Stage] = "tool"
    at = "markers"
    units = ("m", "m", "m")

    def enter(self, arm: Arm, place: str, u: ca.SX) -> None:
        arm.markers[place.removeprefix("marker:")] += u


class LoadPointMotion(Entry):
    """The point where the load hangs moves by u (3,) in the flange frame."""

    name = "load_point_motion"
    stage: ClassVar[Stage] = "load"
    at = "load"
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

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        places, entry = self.entered_at(place, arm.chain), self.entry_at(place)
        motions = ca.vertsplit(self.drive(arm, place, p), entry.size)
        for where, u in zip(places, motions, strict=True):
            entry.enter(arm, where, u)
