"""Effects that the table drives: small motions, and where along the chain they enter."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import casadi as ca

from elastocal.cell.work_cell import Cell
from elastocal.model import rigid
from elastocal.model.arm import ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Effect, Stage, Symbols, index

if TYPE_CHECKING:
    from elastocal.model.arm import Arm


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
    units = ("m", "m", "m", "rad", "rad", "rad")

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
    units = ("m", "m", "m", "rad", "rad", "rad")

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
