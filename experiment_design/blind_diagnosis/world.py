"""A simulated cell: the true arm, what is wrong with it, and what its instrument would report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from mechanics import ElasticArm, Placement, Rest, Spring, Tendon
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skeleton import Array, Skeleton


@dataclass(frozen=True)
class Visits:
    """n visits of a pose: commanded joints (n, J) rad, force (n, 3) N, time (n,) s, direction of
    the last motion of each joint (n, J) ±1, and which pose it is (n,)."""

    q: Array
    force: Array
    time: Array
    approach: Array
    pose: NDArray[np.int64]

    def then(self, later: Visits) -> Visits:
        own, theirs = vars(self), vars(later)
        return Visits(**{key: np.concatenate([own[key], theirs[key]]) for key in own})


@dataclass(frozen=True)
class TrueArm:
    """The arm as it stands: frames with their errors, compliances (J,), joint offsets (J,) rad,
    base position (3,) and rotation (3, 3) in the data's frame, markers (M, 3), hook (3,) m."""

    skeleton: Skeleton
    compliance: Array
    offset: Array
    base_position: Array
    base_rotation: Array
    markers: Array
    marker_names: tuple[str, ...]
    hook: Array


@dataclass
class Motion:
    """Small rigid changes of n visits, which effects add to before the arm is loaded.

    drive (n, J) rad; stretch (n, J) strain of each link; base (n, 6) m, rad along the data's axes
    about the base origin; markers (n, M, 3) m in the flange; force (n, 3) N; hook (n, 3) m.
    """

    drive: Array
    stretch: Array
    base: Array
    markers: Array
    force: Array
    hook: Array


@dataclass
class Sight:
    """What the instrument has in view: marker positions (n, M, 3) m in its frame, which effects
    change, and the flange rotations (n, 3, 3)."""

    points: Array
    flange: Array


@dataclass(frozen=True)
class Hooks:
    """How one kind of effect acts; each part is optional.

    drive: what its joint's drive errs by, (n,) rad.  base: what the base moves by, (n, 6).  move:
    other rigid changes before loading.  springs: more elastic freedom.  tendon: a spring across a
    joint.  slack: what it adds to θ_free (n,) of its joint's spring at load τ (n, H).  play: spring
    → dead zone.  weigh: changes the arm's masses.  see: changes what is reported.
    """

    drive: Callable[[Effect, Visits], Array] | None = None
    base: Callable[[Effect, Visits], Array] | None = None
    move: Callable[[Effect, Visits, Motion], None] | None = None
    springs: Callable[[Effect, TrueArm], list[Spring]] | None = None
    tendon: Callable[[Effect], Tendon] | None = None
    slack: Callable[[Effect, Visits, Array], Array] | None = None
    play: Callable[[Effect], dict[int, float]] | None = None
    weigh: Callable[[Effect, Skeleton], Skeleton] | None = None
    see: Callable[[Effect, TrueArm, Visits, Sight], None] | None = None


@dataclass(frozen=True)
class Effect:
    """What is wrong: its name and place, values in SI, settings (times, orders, periods).

    `where` and the keys of catalogue effects are those of elastocal, so that answers compare.
    `stage` and `driver` state the true location of an effect outside the catalogue; `hooks` say
    how it acts.
    """

    name: str
    where: str
    values: dict[str, float]
    settings: dict[str, float] = field(default_factory=dict)
    stage: str = ""
    driver: str = ""
    hooks: Hooks = Hooks()

    @property
    def index(self) -> int:
        """0-based number of a joint or link: 1 for "joint2"."""
        return int(self.where.lstrip("abcdefghijklmnopqrstuvwxyz")) - 1

    def vector(self, *keys: str) -> Array:
        return np.array([self.values[key] for key in keys])


@dataclass(frozen=True)
class Physics:
    """The true arm with its effects."""

    arm: TrueArm
    effects: tuple[Effect, ...]

    @cached_property
    def _skeleton(self) -> Skeleton:
        skeleton = self.arm.skeleton
        for effect in self.effects:
            if effect.hooks.weigh:
                skeleton = effect.hooks.weigh(effect, skeleton)
        return skeleton

    @cached_property
    def _elastic(self) -> ElasticArm:
        arm = self.arm
        springs = [
            Spring(j + 1, axis, k)
            for j, (axis, k) in enumerate(zip(arm.skeleton.axis, arm.compliance, strict=True))
        ]
        tendon = None
        for effect in self.effects:
            springs += effect.hooks.springs(effect, arm) if effect.hooks.springs else []
            tendon = effect.hooks.tendon(effect) if effect.hooks.tendon else tendon
        return ElasticArm(self._skeleton, springs, tendon)

    def rest(self, visits: Visits, jitter: Array | None = None) -> tuple[Rest, Motion]:
        """Equilibria of all visits; jitter (n, J) rad is added to the drives."""
        motion = self._motion(visits)
        if jitter is not None:
            motion.drive = motion.drive + jitter

        def slack(load: Array) -> Array:
            free = np.zeros_like(load)
            for effect in self.effects:
                if effect.hooks.slack:
                    free[:, effect.index] += effect.hooks.slack(effect, visits, load)
            return free

        play: dict[int, float] = {}
        for effect in self.effects:
            play |= effect.hooks.play(effect) if effect.hooks.play else {}
        drive = visits.q + self.arm.offset + motion.drive
        placement = self._placement(motion)
        rest = self._elastic.rest(drive, placement, motion.force, motion.hook, slack, play)
        return rest, motion

    def readings(self, visits: Visits, jitter: Array | None = None) -> Array:
        """Marker positions (n, M, 3) m as the instrument reports them without noise."""
        rest, motion = self.rest(visits, jitter)
        local = self.arm.markers + motion.markers
        points = rest.position[:, None] + np.einsum("nij,nmj->nmi", rest.rotation, local)
        sight = Sight(points, rest.rotation)
        for effect in self.effects:
            if effect.hooks.see:
                effect.hooks.see(effect, self.arm, visits, sight)
        return sight.points

    def _motion(self, visits: Visits) -> Motion:
        n, J = visits.q.shape
        motion = Motion(
            np.zeros((n, J)), np.zeros((n, J)), np.zeros((n, 6)),
            np.zeros((n, len(self.arm.markers), 3)), visits.force.copy(),
            np.tile(self.arm.hook, (n, 1)),
        )  # fmt: skip
        for effect in self.effects:
            hooks = effect.hooks
            if hooks.drive:
                motion.drive[:, effect.index] += hooks.drive(effect, visits)
            if hooks.base:
                motion.base += hooks.base(effect, visits)
            if hooks.move:
                hooks.move(effect, visits, motion)
        return motion

    def _placement(self, motion: Motion) -> Placement:
        n, arm, skeleton = len(motion.drive), self.arm, self._skeleton
        J = skeleton.n_joints
        position = np.empty((n, J + 2, 3))
        rotation = np.empty((n, J + 2, 3, 3))
        position[:, 0] = arm.base_position + motion.base[:, :3]
        turn = Rotation.from_rotvec(motion.base[:, 3:]).as_matrix()
        rotation[:, 0] = turn @ arm.base_rotation
        position[:, 1:], rotation[:, 1:] = skeleton.position, skeleton.rotation
        position[:, 2:] *= 1 + motion.stretch[:, :, None]
        return Placement(position, rotation)


def reweighed(skeleton: Skeleton, j: int, mass: float, com: Array) -> Skeleton:
    """The skeleton with another mass and centre of mass of the body that joint j moves."""
    masses, coms = skeleton.mass.copy(), skeleton.com.copy()
    masses[j], coms[j] = mass, com
    return replace(skeleton, mass=masses, com=coms)
