"""The shrunk parameters of a model in groups: one for each smooth function, whose size is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from elastocal.model.effects import effect_of
from elastocal.model.effects.base import index
from elastocal.model.effects.smooth import FULL_TURN
from elastocal.model.manipulator import Model
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
        return self.lasting and self.high - self.low >= FULL_TURN * 2 * np.pi

    def grid(self, n: int) -> Array:
        """n values (n,) of what it follows, over its range."""
        return np.linspace(self.low, self.high, n)


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
