"""The suites of worlds, each a stream of recipes that a seed determines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from draw import ALIKE, CATALOGUE, OUTSIDE_EFFECTS, Recipe, Told
from instrument import VARIANTS, Variant
from whole_draw import WholeRecipe

FACTORS = (0.1, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0)
FEW_POSES, MANY_POSES = 60, 300
TOO_FEW_POSES = 20  # campaigns that were ended too early
MOST = 1000  # worlds of one effect; names have three digits
# Worlds of suites that are not counted by effect, over those per effect.
CLEAN, PAIRS = 7, 10
SIZES = 5  # the sweep over sizes has this much fewer per effect and factor
# What 60 poses often leave ambiguous at 0.7 times the size: the first row in any poses, or nearly,
# the second for want of poses.
HARD = (
    "encoder_scale:joint2", "encoder_scale:joint3", "gear_eccentricity:joint3",
    "gear_second_harmonic:joint2", "off_axis_compliance:joint2", "off_axis_compliance:joint3",
    "link_bending:link2", "gear_eccentricity:joint2",
    "payload_error", "thermal_expansion", "link_mass_error", "gear_eccentricity", "encoder_jump",
)  # fmt: skip
Recipes = Iterator[Recipe | WholeRecipe]


@dataclass(frozen=True)
class Suite:
    """`recipes(seed, n)`: worlds, n of each effect; `number` is part of the seed, so that suites
    share no world.

    distance: d of the truth from its rivals; reduction: how far the error truly falls; plan: extra
    poses are measured and diagnosed with the rest; left_out: without the world's own effects;
    whole: what is known of a whole arm.
    """

    number: int
    recipes: Callable[[int, int], Recipes]
    distance: bool = False
    reduction: bool = False
    plan: bool = False
    left_out: bool = False
    whole: bool = False


@dataclass(frozen=True)
class Task:
    """One world to diagnose."""

    suite: str
    recipe: Recipe | WholeRecipe

    @property
    def asked(self) -> Suite:
        return SUITES[self.suite]

    @property
    def without(self) -> tuple[str, ...]:
        """Effects taken out of the catalogue."""
        return self.recipe.effects if self.asked.left_out else ()


def tasks(suite: str, seed: int, per_effect: int) -> Iterator[Task]:
    own = np.random.SeedSequence([seed, SUITES[suite].number]).generate_state(1)
    for recipe in SUITES[suite].recipes(int(own[0]), per_effect):
        yield Task(suite, recipe)


def named(suite: str, seed: int, world: str) -> Task:
    """The suite's task of this world's name, however many the suite has."""
    return next(task for task in tasks(suite, seed, MOST) if task.recipe.name == world)


def _catalogue(seed: int, n: int, poses: int = FEW_POSES, factor: float | None = None) -> Recipes:
    """The same campaigns at every factor."""
    for i, name in enumerate(CATALOGUE):
        for k in range(n):
            size = "" if factor is None else f"-x{factor:g}"
            yield Recipe(f"{name}-{poses}{size}-{k:03d}", (seed, 1, i, k), (name,), factor, poses)


def _sizes(seed: int, n: int) -> Recipes:
    for factor in FACTORS:
        yield from _catalogue(seed, -(-n // SIZES), factor=factor)


def _outside(seed: int, n: int) -> Recipes:
    for i, name in enumerate(OUTSIDE_EFFECTS):
        for k in range(n):
            yield Recipe(f"{name}-{FEW_POSES}-{k:03d}", (seed, 2, i, k), (name,), 2.0)


def _clean(variant: Variant, told: Told, seed: int, n: int) -> Recipes:
    for k in range(CLEAN * n):
        name = f"clean-{variant}-{FEW_POSES}-{k:03d}"
        yield Recipe(name, (seed, 3, k), variant=variant, told=told)


def _pairs(seed: int, n: int) -> Recipes:
    """Two different effects of the catalogue at once."""
    for k in range(PAIRS * n):
        pick = np.random.default_rng((seed, 4, k)).choice(len(CATALOGUE), 2, replace=False)
        names = tuple(CATALOGUE[i] for i in pick)
        yield Recipe(f"pair-{FEW_POSES}-{k:03d}", (seed, 4, k, 1), names, 1.5)


def _alike(seed: int, n: int) -> Recipes:
    for i, effect in enumerate(ALIKE):
        for k in range(n):
            name = f"alike-{effect.replace(':', '-')}-{FEW_POSES}-{k:03d}"
            yield Recipe(name, (seed, 5, i, k), (effect,))


def _hard(seed: int, n: int) -> Recipes:
    for i, effect in enumerate(HARD):
        for k in range(n):
            yield Recipe(f"plan-{effect.replace(':', '-')}-{k:03d}", (seed, i, k), (effect,), 0.7)


def _whole(poses: int, seed: int, n: int) -> Recipes:
    for k in range(n):
        yield WholeRecipe(f"whole-{poses}-{k:03d}", (seed, 9, k), poses)


SUITES = {
    "catalogue": Suite(0, _catalogue, distance=True, reduction=True),
    "catalogue300": Suite(1, partial(_catalogue, poses=MANY_POSES), distance=True, reduction=True),
    "alike": Suite(2, _alike, distance=True),
    **{f"clean-{v}": Suite(3 + k, partial(_clean, v, Told())) for k, v in enumerate(VARIANTS)},
    "pairs": Suite(9, _pairs, distance=True),
    "outside": Suite(10, _outside),
    "left_out": Suite(11, partial(_catalogue, factor=2.0), distance=True, left_out=True),
    "sizes": Suite(12, _sizes, distance=True),
    "plan": Suite(13, _hard, plan=True),
    "plan20": Suite(14, partial(_catalogue, poses=TOO_FEW_POSES), plan=True),
    "whole": Suite(15, partial(_whole, FEW_POSES), whole=True),
    "whole300": Suite(16, partial(_whole, MANY_POSES), whole=True),
    **{
        f"timeless-{v}": Suite(17 + k, partial(_clean, v, Told(time=False)))
        for k, v in enumerate(VARIANTS)
    },
}
