"""The shrunk parameters of a model in groups: one for each smooth function, whose size is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.model.effects.base import Effect, SmoothFunction, index
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.smooth import FULL_TURN
from elastocal.model.manipulator import Model, load_chain
from elastocal.units import Array, IntArray


@dataclass(frozen=True)
class SmoothGroup:
    """Shrunk parameters that have one scale: those of a smooth function, or of an effect's place.

    `columns` (components, waves) index the model's parameters; `units` (components,) are those of
    the function's values.  `follows` is "joint2" or "time", with the prior's `size` and `length`
    and the range `low` to `high`; "" and NaN where the parameters are no function of one quantity,
    and `basis` None.
    """

    effect: str
    where: str
    follows: str
    columns: IntArray
    units: tuple[str, ...]
    size: float
    length: float
    low: float
    high: float
    basis: Callable[[Array], Array] | None

    @property
    def name(self) -> str:
        """ "joint curve of joint2", "residual field of link3, following joint1"."""
        text = f"{self.effect.replace('_', ' ')} of {self.where}"
        return text if self.follows in ("", self.where) else f"{text}, following {self.follows}"

    @property
    def lasting(self) -> bool:
        """Whether it belongs to the arm, and not to the time of one campaign."""
        return self.follows != "time"

    @property
    def joint(self) -> int:
        """Index of the joint that it follows."""
        return index(self.follows)

    @property
    def whole_turn(self) -> bool:
        """Whether it was measured all the way round, so that no angle lies outside."""
        return self.lasting and turns_all_round(self)

    def grid(self, n: int) -> Array:
        """n values (n,) of what it follows, over its range."""
        return np.linspace(self.low, self.high, n)


def turns_all_round(f: SmoothGroup | SmoothFunction) -> bool:
    """Whether its range is a whole turn of a joint."""
    return f.high - f.low >= FULL_TURN * 2 * np.pi


def where_smooth_functions_end(cell: Cell) -> str:
    """Up to where the cell's smooth functions correct the arm, "joint1 from -85.9° to 85.9°, …";
    empty where none ends."""
    chosen = [(effect_of(choice.name), choice.where) for choice in cell.model.effects]
    chosen = [each for each in chosen if type(each[0]).functions is not Effect.functions]
    chain = load_chain(cell) if chosen else None
    ends: dict[str, tuple[float, float]] = {}
    for effect, place in chosen:
        assert chain is not None
        for where in [place] if place else effect.places(chain, cell):
            for f in effect.functions(where, chain, cell):
                if f.follows == "time" or not turns_all_round(f):
                    low, high = ends.get(f.follows, (f.low, f.high))
                    ends[f.follows] = min(low, f.low), max(high, f.high)
    return ", ".join(
        f"{name} from {low:.0f} s to {high:.0f} s" if name == "time"
        else f"{name} from {np.degrees(low):.1f}° to {np.degrees(high):.1f}°"
        for name, (low, high) in sorted(ends.items())
    )  # fmt: skip


def smooth_groups(model: Model) -> tuple[SmoothGroup, ...]:
    """The groups of all shrunk parameters, in the model's order."""
    place = {name: k for k, name in enumerate(model.names)}
    found: list[SmoothGroup] = []
    for effect, where in dict.fromkeys((p.effect, p.where) for p in model.parameters if p.shrunk):
        own = [
            k for k, p in enumerate(model.parameters)
            if p.shrunk and (p.effect, p.where) == (effect, where)
        ]  # fmt: skip
        for f in effect_of(effect).functions(where, model.chain, model.cell):
            columns = np.array([[place[f"{where}.{key}"] for key in keys] for keys in f.keys])
            found.append(
                SmoothGroup(
                    effect, where, f.follows, columns, f.units, f.size, f.length, f.low, f.high,
                    f.basis,
                )
            )  # fmt: skip
            own = sorted(set(own) - set(columns.ravel().tolist()))
        for unit in dict.fromkeys(model.parameters[k].unit for k in own):
            alike = [k for k in own if model.parameters[k].unit == unit]
            size = float(np.sqrt(sum((model.parameters[k].typical or 0.0) ** 2 for k in alike)))
            nan, columns = float("nan"), np.array([alike])
            found.append(
                SmoothGroup(effect, where, "", columns, (unit,), size, nan, nan, nan, None)
            )
    return tuple(found)
