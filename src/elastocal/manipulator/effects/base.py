"""What every effect is: its parameters, its places in the chain, its expression."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import casadi as ca

from elastocal.cell import Cell
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.parameter import ParameterSpec, Setting

if TYPE_CHECKING:
    from elastocal.manipulator.arm import Arm

Stage = Literal["transmission", "geometry", "load", "compliance", "tool", "tracker"]
Symbols = Mapping[str, ca.SX]
REVOLUTE = "revolute"


class Effect:
    """One physical effect on the chain.  It knows nothing about estimation.

    A subclass states `name` and `stage`, the places where it can act, the
    parameters it has at a place, and overrides the one hook its stage calls for:

    - `shape`: changes joint motion, link transforms, springs, markers, base frame;
      called before the chain is put together.
    - `load`: adds forces or potentials; called when every point's position is known
      as a function of the elastic deflections.
    - `read`: changes what the instrument reports; called last.

    Parameter symbols arrive as a mapping from the keys of `parameters` and `settings` to CasADi
    scalars.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    # What the table must say for the effect to show, of "time", "approach", "temperature", "load".
    needs: ClassVar[tuple[str, ...]] = ()

    def places(self, chain: Chain, cell: Cell) -> tuple[str, ...]:
        """Every place where this effect makes sense on this arm, e.g. ("joint1", …)."""
        raise NotImplementedError

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        """The parameters at one place; loads may have none."""
        return ()

    def starts(self, place: str, chain: Chain, cell: Cell) -> tuple[dict[str, float], ...]:
        """Values of some parameters from which to look for the others, where nominal ones say
        nothing about this arm."""
        return ()

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        """Constants of the expression at one place that are set or searched, not fitted."""
        return ()

    def needed(self, cell: Cell) -> tuple[str, ...]:
        """`needs` for this cell: what shows an effect may depend on the model around it."""
        return self.needs

    def shape(self, arm: Arm, place: str, p: Symbols) -> None:
        """Change the pieces of the chain before it is assembled."""

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        """Add forces or potentials once points are known."""

    def read(self, arm: Arm, place: str, p: Symbols) -> None:
        """Change the instrument's reading."""


def joints(chain: Chain) -> tuple[str, ...]:
    """Places "joint1" … "jointN"."""
    return tuple(f"joint{i + 1}" for i in range(chain.n_joints))


def turning_joints(chain: Chain) -> tuple[str, ...]:
    """Those of `joints` that are revolute."""
    return tuple(j for j, kind in zip(joints(chain), chain.kinds, strict=True) if kind == REVOLUTE)


def motion_unit(place: str, chain: Chain) -> str:
    """Unit of the motion of "jointN": rad, or m where it slides."""
    return "rad" if chain.kinds[index(place)] == REVOLUTE else "m"


def links(chain: Chain) -> tuple[str, ...]:
    """Places "link1" … "linkN"; link i is the body that joint i moves."""
    return tuple(f"link{i + 1}" for i in range(chain.n_joints))


def index(place: str) -> int:
    """0-based index of "joint3" or "link3"."""
    return int(place.lstrip("abcdefghijklmnopqrstuvwxyz")) - 1
