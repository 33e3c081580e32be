"""Where on an arm an effect may sit, and the distributions that worlds are drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from arm_data import ArmSpec
from skeleton import Array
from world import TrueArm

AT_WORK = 0.2  # a joint is at work where its deflection is this share of the largest joint's


@dataclass(frozen=True)
class Site:
    """What sizes depend on: the arm, the load's torque on each joint (n, J) N·m at the campaign's
    visits, its duration in s, and the ripple orders (J,) that the cell lists."""

    spec: ArmSpec
    arm: TrueArm
    load: Array
    duration: float
    orders: Array

    @property
    def torque(self) -> Array:
        """Largest torque on each joint (J,)."""
        return np.abs(self.load).max(axis=0)

    @property
    def joints(self) -> list[int]:
        return list(range(self.load.shape[1]))

    @property
    def at_work(self) -> list[int]:
        """Joints that the load turns; no torque effect shows at the others."""
        given = self.arm.compliance * self.torque
        return [j for j in self.joints if given[j] >= AT_WORK * given.max()]

    @property
    def two_sided(self) -> list[int]:
        """Joints at work that the load turns either way, depending on the pose."""
        high, low = self.load.max(axis=0), -self.load.min(axis=0)
        both = np.minimum(high, low) >= AT_WORK * self.torque
        return [j for j in self.at_work if both[j]]

    @property
    def long_links(self) -> list[int]:
        lengths = [np.linalg.norm(self.arm.skeleton.link_vector(j)) for j in self.joints]
        return [j for j in self.joints if lengths[j] > 0.05 * self.spec.reach]

    @property
    def massive_links(self) -> list[int]:
        """Links with a tenth of the moving mass or more; the first one turns about the vertical."""
        mass = self.arm.skeleton.mass
        return [j for j in self.joints[1:] if mass[j] >= 0.1 * mass.sum()]


# site → (where, index) of each place
Places = Callable[[Site], list[tuple[str, int]]]


def at(kind: str, chosen: Callable[[Site], list[int]]) -> Places:
    """Joints or links by 0-based index."""
    return lambda site: [(f"{kind}{j + 1}", j) for j in chosen(site)]


def only(where: str) -> Places:
    return lambda site: [(where, 0)]


def markers(site: Site) -> list[tuple[str, int]]:
    return [(f"marker:{name}", k) for k, name in enumerate(site.arm.marker_names)]


def all_or_one(site: Site) -> list[tuple[str, int]]:
    """Every second warm arm is warm all over."""
    single = at("link", lambda s: s.long_links)(site)
    return [("all", 0)] * len(single) + single


def compensators(site: Site) -> list[tuple[str, int]]:
    return [("joint2", 1)] if site.spec.has_compensator else []


# The few distributions that worlds are drawn from.

Values = dict[str, float]


def log_uniform(bounds: tuple[float, float], rng: np.random.Generator) -> float:
    """A number whose logarithm is uniform between those of the bounds."""
    low, high = np.log(bounds)
    return float(np.exp(rng.uniform(low, high)))


def sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def spread(keys: tuple[str, ...], size: float, rng: np.random.Generator) -> Values:
    """Components of a random direction, their rms `size`."""
    v = rng.normal(size=len(keys))
    v *= size * np.sqrt(len(keys)) / np.linalg.norm(v)
    return dict(zip(keys, v.tolist(), strict=True))


def positive(keys: tuple[str, ...], size: float, rng: np.random.Generator) -> Values:
    """Compliances about `size`, none of them the same."""
    return {key: float(size * rng.uniform(0.7, 1.3)) for key in keys}
