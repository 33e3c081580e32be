"""Worlds of the blind check, drawn from a seed.

    for world in catalogue_worlds(seed=7, per_effect=30):
        write_world(world, visible / world.name, sealed / world.name)

Everything that the tool may see goes to the first folder, what it may not to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ParamSpec

import numpy as np
from arm_data import ARMS, ArmSpec, Specimen, draw_specimen
from chance import log_uniform
from inside import INSIDE
from instrument import Noise, Variant, draw_noise
from numpy.typing import NDArray
from outside import OUTSIDE, draw_outside
from places import Site
from sizes import KINDS, ORDERS, draw_effect, possible
from visits import Plan, draw_poses, draw_visits
from whole_laws import WHOLE
from world import Effect, Physics, Visits

Array = NDArray[np.float64]
CATALOGUE: tuple[str, ...] = tuple(KINDS)
OUTSIDE_EFFECTS: tuple[str, ...] = tuple(OUTSIDE)
HOOKS = INSIDE | {name: kind.hooks for name, kind in OUTSIDE.items()} | WHOLE
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
        return Physics(self.specimen.true, self.effects, HOOKS)

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


def draw_world(
    seed: Sequence[int],
    name: str,
    effects: Sequence[str] = (),
    *,
    factor: float | None = None,
    poses: int = 60,
    arm: str | None = None,
    level: float | None = None,
    variant: Variant = "as_modelled",
    told: Told = Told(),
) -> World:
    """A world with the named effects, in the catalogue or outside it, at random places.

    A catalogue effect may be given its place: "gear_eccentricity:joint2".
    factor: size over realistic size, else log-uniform; arm: one of ARMS, else any that can have
    the effects; level: tracker noise in m, else log-uniform.
    """
    rng = np.random.default_rng((*seed, 0))
    names = [effect.partition(":")[0] for effect in effects]
    able = [n for n, spec in ARMS.items() if all(possible(e, spec) for e in names)]
    drawn = able[rng.integers(len(able))]
    spec = ARMS[drawn if arm is None else arm]
    specimen = draw_specimen(spec, rng)
    J = spec.skeleton.n_joints
    orders = np.array([log_uniform(ORDERS, rng) for _ in range(J)]).round(1)
    plan: Plan = "interleaved" if rng.random() < 0.5 else "blocks"
    by_motion = bool(rng.random() < 0.5)
    visits = draw_visits(spec, draw_poses(spec, poses, rng), plan, by_motion, rng)
    distance = float(np.linalg.norm(specimen.base_position))
    noise = draw_noise(variant, J, distance, rng, level)
    load = Physics(specimen.true, (), HOOKS).rest(visits)[0].load
    site = Site(spec, specimen.true, load, float(visits.time[-1]), orders)
    found = tuple(
        (draw_effect if name in KINDS else draw_outside)(effect, site, rng, factor)
        for name, effect in zip(names, effects, strict=True)
    )
    return World(
        name, tuple(seed), spec, specimen, found, orders, visits, plan, by_motion, noise, told
    )


@dataclass(frozen=True)
class Recipe:
    """What a world is drawn from; see `draw_world`."""

    name: str
    seed: tuple[int, ...]
    effects: tuple[str, ...] = ()
    factor: float | None = None
    poses: int = 60
    variant: Variant = "as_modelled"
    told: Told = Told()

    def draw(self) -> World:
        return draw_world(
            self.seed,
            self.name,
            self.effects,
            factor=self.factor,
            poses=self.poses,
            variant=self.variant,
            told=self.told,
        )


def catalogue_recipes(
    seed: int,
    per_effect: int = 30,
    names: Sequence[str] = CATALOGUE,
    *,
    factor: float | None = None,
    poses: int = 60,
) -> Iterator[Recipe]:
    """`per_effect` worlds of each catalogue effect alone; the same campaigns at every factor."""
    for name in names:
        for k in range(per_effect):
            key = (seed, 1, CATALOGUE.index(name), k)
            size = "" if factor is None else f"-x{factor:g}"
            yield Recipe(f"{name}-{poses}{size}-{k:03d}", key, (name,), factor, poses)


def outside_recipes(
    seed: int, per_effect: int = 30, *, factor: float | None = 2.0, poses: int = 60
) -> Iterator[Recipe]:
    """`per_effect` worlds of each effect that the catalogue does not have, at twice the size."""
    for i, name in enumerate(OUTSIDE_EFFECTS):
        for k in range(per_effect):
            yield Recipe(f"{name}-{poses}-{k:03d}", (seed, 2, i, k), (name,), factor, poses)


def clean_recipes(
    seed: int,
    count: int,
    variant: Variant = "as_modelled",
    *,
    poses: int = 60,
    told: Told = Told(),
) -> Iterator[Recipe]:
    """Worlds with no effect, under one variant of the noise."""
    for k in range(count):
        name = f"clean-{variant}-{poses}-{k:03d}"
        yield Recipe(name, (seed, 3, k), poses=poses, variant=variant, told=told)


def pair_recipes(
    seed: int, count: int, *, factor: float | None = 1.5, poses: int = 60
) -> Iterator[Recipe]:
    """Worlds with two different catalogue effects at once."""
    for k in range(count):
        pick = np.random.default_rng((seed, 4, k)).choice(len(CATALOGUE), 2, replace=False)
        names = tuple(CATALOGUE[i] for i in pick)
        yield Recipe(f"pair-{poses}-{k:03d}", (seed, 4, k, 1), names, factor, poses)


def alike_recipes(
    seed: int, per_case: int = 30, *, factor: float | None = None, poses: int = 60
) -> Iterator[Recipe]:
    """`per_case` worlds of each effect in ALIKE."""
    for i, effect in enumerate(ALIKE):
        for k in range(per_case):
            name = f"alike-{effect.replace(':', '-')}-{poses}-{k:03d}"
            yield Recipe(name, (seed, 5, i, k), (effect,), factor, poses)


Arguments = ParamSpec("Arguments")


def _drawn(
    recipes: Callable[Arguments, Iterator[Recipe]],
) -> Callable[Arguments, Iterator[World]]:
    def worlds(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Iterator[World]:
        return (recipe.draw() for recipe in recipes(*args, **kwargs))

    return worlds


catalogue_worlds = _drawn(catalogue_recipes)
outside_worlds = _drawn(outside_recipes)
clean_worlds = _drawn(clean_recipes)
pair_worlds = _drawn(pair_recipes)
alike_worlds = _drawn(alike_recipes)
