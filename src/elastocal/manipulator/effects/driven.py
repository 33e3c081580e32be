"""Effects that are a known motion of the chain, driven by what the table says of a row."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects.base import Effect, Symbols
from elastocal.manipulator.effects.entry import Entry

if TYPE_CHECKING:
    from elastocal.manipulator.arm import Arm


class DrivenEffect(Effect):
    """u = D(row) p at an `entry` of the chain: linear in its parameters p.

    The drive D depends on the row (joint angles, time, approach direction) and on the effect's
    settings, not on the arm's deflection.  So B = ∂(reading)/∂u · D, and a search over settings
    evaluates D alone.
    """

    entry: ClassVar[Entry]

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        return self.entry.places(chain, cell)

    @abstractmethod
    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        """u of the row, linear in the parameters: (entry.size,) of every entered place, stacked."""

    def entered_at(self, place: str, chain: Chain) -> tuple[str, ...]:
        """The places of the entry that u acts on, in the order in which u stacks them."""
        return (place,)

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        places = self.entered_at(place, arm.chain)
        motions = ca.vertsplit(self.drive(arm, place, p), self.entry.size)
        for where, u in zip(places, motions, strict=True):
            self.entry.enter(arm, where, u)
