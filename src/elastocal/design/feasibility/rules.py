"""What a rule of the cell is, and those that bound a quantity of the pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.feasibility.frames import Poses

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SAME = 1e-9  # rounding of a joint value that was set to its limit


class Rule(ABC):
    """One thing a pose must respect."""

    name: str

    @abstractmethod
    def broken(self, poses: Poses) -> BoolArray:
        """(N,): the pose breaks this rule."""

    @abstractmethod
    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        """By what: a joint, a marker, a pair of bodies → (N,)."""

    @abstractmethod
    def remedy(self, poses: Poses) -> str:
        """What to relax for poses that break this rule and no other."""


@dataclass(frozen=True)
class Bound(Rule):
    """lower ≤ quantity ≤ upper: joint values, range, incidence, rope angle, torque.

    `quantity` gives (N, m), `labels` (m) name its columns, `units` (m) or one for all are what
    messages show them in: "°" for quantities in rad.  `key`: what the user calls the limit.
    """

    name: str
    quantity: Callable[[Poses], Array]
    lower: Array
    upper: Array
    labels: tuple[str, ...]
    key: str
    units: tuple[str, ...]

    def _beyond(self, poses: Poses) -> tuple[Array, BoolArray, BoolArray]:
        value = self.quantity(poses)
        return value, value < self.lower - SAME, value > self.upper + SAME

    def broken(self, poses: Poses) -> BoolArray:
        _, below, above = self._beyond(poses)
        return np.asarray((below | above).any(axis=1))

    def causes(self, poses: Poses) -> dict[str, BoolArray]:
        _, below, above = self._beyond(poses)
        return {label: below[:, i] | above[:, i] for i, label in enumerate(self.labels)}

    def remedy(self, poses: Poses) -> str:
        value, below, above = self._beyond(poses)
        i = int((below | above).sum(axis=0).argmax())
        low = below[:, i].sum() > above[:, i].sum()
        limit = np.broadcast_to(self.lower if low else self.upper, len(self.labels))[i]
        half = np.median(value[below[:, i] if low else above[:, i], i])
        unit = self.units[i % len(self.units)]
        scale = 180 / np.pi if unit == "°" else 1.0
        return (
            f"{self.key} of {half * scale:.4g} {unit} instead of {limit * scale:.4g} {unit} for "
            f"{self.labels[i]} would let half of those pass"
        )
