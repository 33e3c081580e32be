"""The suites of worlds, each of them a stream of tasks that a seed determines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from draw import (
    Recipe,
    Told,
    alike_recipes,
    catalogue_recipes,
    clean_recipes,
    outside_recipes,
    pair_recipes,
)
from instrument import VARIANTS
from whole_draw import WholeRecipe

FACTORS = (0.1, 0.2, 0.35, 0.6, 1.0, 2.0, 4.0)
FEW_POSES, MANY_POSES = 60, 300
TOO_FEW_POSES = 20  # campaigns that were ended too early
LEFT_OUT_FACTOR = 2.0
MOST = 1000  # worlds of one effect; names have three digits
# Worlds of suites that are not counted by effect, over those per effect.
CLEAN, PAIRS = 7, 10
SIZES = 5  # the sweep over sizes has this much fewer per effect and factor
# What 60 poses often leave ambiguous at this size: the first row in any poses, or nearly, the
# second for want of poses.
HARD = (
    "encoder_scale:joint2", "encoder_scale:joint3", "gear_eccentricity:joint3",
    "gear_second_harmonic:joint2", "off_axis_compliance:joint2", "off_axis_compliance:joint3",
    "link_bending:link2", "gear_eccentricity:joint2",
    "payload_error", "thermal_expansion", "link_mass_error", "gear_eccentricity", "encoder_jump",
)  # fmt: skip
HARD_FACTOR = 0.7


@dataclass(frozen=True)
class Task:
    """One world to diagnose.

    without: effects taken out of the catalogue.  Also wanted: distance d of the truth from its
    rivals, the true shrinkage, extra poses, measured and diagnosed with the rest, and what is
    known of a whole arm.
    """

    suite: str
    recipe: Recipe | WholeRecipe
    without: tuple[str, ...] = ()
    distance: bool = False
    shrinkage: bool = False
    plan: bool = False
    whole: bool = False


def tasks(suite: str, seed: int, per_effect: int) -> Iterator[Task]:
    """The suite's tasks; suites share no world."""
    own = np.random.SeedSequence([seed, list(SUITES).index(suite)]).generate_state(1)
    yield from SUITES[suite](suite, int(own[0]), per_effect)


def named(suite: str, seed: int, world: str) -> Task:
    """The suite's task of this world's name, however many the suite has."""
    return next(task for task in tasks(suite, seed, MOST) if task.recipe.name == world)


def _catalogue(poses: int, suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in catalogue_recipes(seed, n, poses=poses):
        yield Task(suite, recipe, distance=True, shrinkage=True)


def _alike(suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in alike_recipes(seed, n):
        yield Task(suite, recipe, distance=True)


def _clean(suite: str, seed: int, n: int) -> Iterator[Task]:
    variant = next(v for v in VARIANTS if suite == f"clean-{v}")
    for recipe in clean_recipes(seed, CLEAN * n, variant):
        yield Task(suite, recipe)


def _timeless(suite: str, seed: int, n: int) -> Iterator[Task]:
    """No effect, and a table that does not say when its readings were taken."""
    variant = next(v for v in VARIANTS if suite == f"timeless-{v}")
    for recipe in clean_recipes(seed, CLEAN * n, variant, told=Told(time=False)):
        yield Task(suite, recipe)


def _pairs(suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in pair_recipes(seed, PAIRS * n):
        yield Task(suite, recipe, distance=True)


def _outside(suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in outside_recipes(seed, n):
        yield Task(suite, recipe)


def _left_out(suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in catalogue_recipes(seed, n, factor=LEFT_OUT_FACTOR):
        yield Task(suite, recipe, without=recipe.effects, distance=True)


def _sizes(suite: str, seed: int, n: int) -> Iterator[Task]:
    """The same campaigns at every factor."""
    for factor in FACTORS:
        for recipe in catalogue_recipes(seed, -(-n // SIZES), factor=factor):
            yield Task(suite, recipe, distance=True)


def _plan(suite: str, seed: int, n: int) -> Iterator[Task]:
    for i, effect in enumerate(HARD):
        for k in range(n):
            name = f"plan-{effect.replace(':', '-')}-{k:03d}"
            yield Task(suite, Recipe(name, (seed, i, k), (effect,), HARD_FACTOR), plan=True)


def _plan_early(suite: str, seed: int, n: int) -> Iterator[Task]:
    for recipe in catalogue_recipes(seed, n, poses=TOO_FEW_POSES):
        yield Task(suite, recipe, plan=True)


def _whole(poses: int, suite: str, seed: int, n: int) -> Iterator[Task]:
    for k in range(n):
        recipe = WholeRecipe(f"whole-{poses}-{k:03d}", (seed, 9, k), poses)
        yield Task(suite, recipe, whole=True)


SUITES: dict[str, Callable[[str, int, int], Iterator[Task]]] = {
    "catalogue": partial(_catalogue, FEW_POSES),
    "catalogue300": partial(_catalogue, MANY_POSES),
    "alike": _alike,
    **{f"clean-{variant}": _clean for variant in VARIANTS},
    "pairs": _pairs,
    "outside": _outside,
    "left_out": _left_out,
    "sizes": _sizes,
    "plan": _plan,
    "plan20": _plan_early,
    # A suite's place in this list is part of its seed.
    "whole": partial(_whole, FEW_POSES),
    "whole300": partial(_whole, MANY_POSES),
    **{f"timeless-{variant}": _timeless for variant in VARIANTS},
}
WHOLE_SUITES = ("whole", "whole300")
