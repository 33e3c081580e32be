"""Worlds of the blind check, each drawn from its recipe.

    write_world(Recipe("play", (7, 1), ("backlash",)).draw(), visible, sealed)

Everything that the tool may see goes to the first folder, what it may not to the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from arm_data import ARMS, ArmSpec, Specimen, draw_specimen
from inside import KINDS, ORDERS, draw_effect, possible
from instrument import Noise, Variant, draw_noise
from outside import OUTSIDE, draw_outside
from places import Site, log_uniform
from skeleton import Array
from world import Effect, Physics, Visits

Plan = Literal["interleaved", "blocks"]

MINUTES_PER_VISIT = 0.6
CLEARANCE = 0.08  # markers and joints stay this share of the reach above the base's foot
SEPARATION = 0.05  # rad, in the joint that differs most: no pose twice
CATALOGUE: tuple[str, ...] = tuple(KINDS)
OUTSIDE_EFFECTS: tuple[str, ...] = tuple(OUTSIDE)
# Effects that another one imitates at any poses, and that other; joint 1 is vertical.
ALIKE = {
    "gear_eccentricity:joint2": "link_mass_error:link2",
    "link_mass_error:link2": "gear_eccentricity:joint2",
    "joint_drift:joint1": "base_drift:base",
    "encoder_jump:joint1": "frame_jump:tracker",
}
FRESH_POSES = 100


@dataclass(frozen=True)
class Told:
    """What cell and readings tell of the arm: its links' weights, the times of the readings, and
    from which side each joint came."""

    weights: bool = True
    time: bool = True
    approach: bool = True


@dataclass(frozen=True)
class World:
    """One campaign on one specimen.  `seed` (numbers) reproduces its readings."""

    name: str
    seed: tuple[int, ...]
    spec: ArmSpec
    specimen: Specimen
    effects: tuple[Effect, ...]
    orders: Array
    visits: Visits
    plan: Plan
    approach_by_motion: bool
    noise: Noise
    told: Told = Told()

    @property
    def physics(self) -> Physics:
        return Physics(self.specimen.true, self.effects)

    def measure(self, visits: Visits, rng: np.random.Generator) -> Array:
        """Noisy readings (n, M, 3) m of any visits: also of poses that were proposed later."""
        jitter = self.noise.jitter(visits.pose, rng)
        return self.noise.add(self.physics.readings(visits, jitter), rng)

    def readings(self) -> Array:
        """The campaign's own readings (n, M, 3) m, always the same."""
        return self.measure(self.visits, np.random.default_rng((*self.seed, 1)))

    def fresh(self) -> Visits:
        """100 other poses, unloaded and loaded, over the same period.

        Where no approach is told, joints stand free at the first: nobody knows where it came from.
        """
        rng = np.random.default_rng((*self.seed, 2))
        poses = draw_poses(self.spec, FRESH_POSES, rng)
        visits = draw_visits(self.spec, poses, "interleaved", self.approach_by_motion, rng)
        if not self.told.approach:
            visits.approach[visits.pose == visits.pose[0]] = 0.0
        return replace(visits, time=visits.time * (self.visits.time[-1] / visits.time[-1]))

    def noise_free(self, visits: Visits) -> Array:
        """Readings (n, M, 3) m without noise and at perfect repeatability."""
        return self.physics.readings(visits)


@dataclass(frozen=True)
class Recipe:
    """What a world is drawn from: effects of the catalogue or outside it, at random places.

    A catalogue effect may be given its place: "gear_eccentricity:joint2".
    factor: size over realistic size, else log-uniform; arm: one of ARMS, else any that can have
    the effects; level: tracker noise in m, else log-uniform.
    """

    name: str
    seed: tuple[int, ...]
    effects: tuple[str, ...] = ()
    factor: float | None = None
    poses: int = 60
    variant: Variant = "as_modelled"
    told: Told = Told()
    arm: str | None = None
    level: float | None = None

    def draw(self) -> World:
        rng = np.random.default_rng((*self.seed, 0))
        names = [effect.partition(":")[0] for effect in self.effects]
        able = [n for n, spec in ARMS.items() if all(possible(e, spec) for e in names)]
        drawn = able[rng.integers(len(able))]
        spec = ARMS[self.arm or drawn]
        specimen = draw_specimen(spec, rng)
        J = spec.skeleton.n_joints
        orders = np.array([log_uniform(ORDERS, rng) for _ in range(J)]).round(1)
        plan: Plan = "interleaved" if rng.random() < 0.5 else "blocks"
        by_motion = bool(rng.random() < 0.5)
        visits = draw_visits(spec, draw_poses(spec, self.poses, rng), plan, by_motion, rng)
        distance = float(np.linalg.norm(specimen.base_position))
        noise = draw_noise(self.variant, J, distance, rng, self.level)
        load = Physics(specimen.true, ()).rest(visits)[0].load
        site = Site(spec, specimen.true, load, float(visits.time[-1]), orders)
        effects = tuple(
            (draw_effect if name in KINDS else draw_outside)(effect, site, rng, self.factor)
            for name, effect in zip(names, self.effects, strict=True)
        )
        return World(
            self.name, self.seed, spec, specimen, effects, orders, visits, plan, by_motion,
            noise, self.told,
        )  # fmt: skip


# Which poses are measured, in which order, when, and from which side each joint came.


def draw_poses(spec: ArmSpec, n: int, rng: np.random.Generator) -> Array:
    """(n, J) rad, uniform in the joint limits, above the floor, all distinct; 9 decimals."""
    s = spec.skeleton
    kept: list[Array] = []
    while len(kept) < n:
        q = rng.uniform(s.lower, s.upper, (4 * n, s.n_joints)).round(9)
        R, p = s.forward(q)
        points = np.concatenate([np.array(spec.markers), [spec.hook]])
        tool = p[:, -1, None] + np.einsum("nij,mj->nmi", R[:, -1], points)
        lowest = np.minimum(p[:, 2:, 2].min(axis=1), tool[..., 2].min(axis=1))
        for pose in q[lowest > CLEARANCE * spec.reach]:
            if len(kept) < n and all(np.abs(pose - k).max() > SEPARATION for k in kept):
                kept.append(pose)
    return np.array(kept)


def draw_visits(
    spec: ArmSpec, poses: Array, plan: Plan, approach_by_motion: bool, rng: np.random.Generator
) -> Visits:
    """Every pose (n, J) unloaded and loaded, in the order given.

    "interleaved": the load goes on right after, without a motion; "blocks": all poses unloaded,
    then all loaded.  `approach_by_motion`: directions are those of the motion from the pose
    before; else the controller approaches each joint from a side of its own choice.
    """
    n, J = poses.shape
    order = np.arange(n)
    if plan == "interleaved":
        pose, loaded = np.repeat(order, 2), np.tile([False, True], n)
    else:
        pose, loaded = np.tile(order, 2), np.repeat([False, True], n)
    q = poses[pose]
    step = np.diff(q, axis=0, prepend=rng.uniform(-1, 1, (1, J)))
    approach = np.sign(step) if approach_by_motion else rng.choice([-1.0, 1.0], q.shape)
    for i in np.flatnonzero(~step.any(axis=1)):
        approach[i] = approach[i - 1]
    force = np.outer(loaded, [0.0, 0.0, -spec.payload])
    minutes = MINUTES_PER_VISIT * rng.uniform(0.9, 1.1, len(pose))
    time = (np.cumsum(minutes) - minutes[0]).round(3) * 60
    return Visits(q, force, time, approach, pose)
