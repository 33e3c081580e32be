"""On which law the play of an arm's gears follows: load alone, or load and last motion.

A gear whose friction is small swings into the middle of its play, or onto the flank that any
load pushes it to; one that is stiff in its bearings stays where the last motion left it until the
load exceeds the friction.  Both are met, and the wrong one leaves most of the effect standing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.gram import Grams, scales_of
from elastocal.diagnosis.model_set import Item, fit_set
from elastocal.diagnosis.noise import NoiseValues
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.scene import Scene, scene_of
from elastocal.manipulator.model import Model

EFFECT, BY_LOAD, BY_BOTH = "backlash", "load", "load_and_approach"


def with_likelier_play(scene: Scene) -> Scene:
    """The scene under the law of play that its readings make likelier.

    Where no side of approach is recorded, or the cell has play already, it stays as it is.
    """
    spec = scene.base.model.cell.model
    play = [h for h in scene.hypotheses if h.name == EFFECT]
    if spec.play_side != BY_BOTH or not play:
        return scene
    noise = scene.noise
    other = _under(scene.base, BY_LOAD)
    under_other = scene_of(other, play)
    under_other = replace(under_other, data=replace(under_other.data, left_out=scene.data.left_out))
    if _best(under_other, noise) <= _best(scene, noise):
        return scene
    rows = scene.columns.rows.copy()
    for h in play:
        rows[:, :, scene.columns.places[h.name, h.where]] = under_other.columns.of(h)
    return replace(scene, base=other, columns=replace(scene.columns, base=other, rows=rows))


def _under(base: Baseline, law: str) -> Baseline:
    model = base.model
    spec = replace(model.cell.model, play_side=law)  # type: ignore[arg-type]
    return replace(base, model=Model(model.chain, replace(model.cell, model=spec)))


def _best(scene: Scene, noise: NoiseValues) -> float:
    """Log evidence of play in the joint where it is likeliest, the noise fitted beside it."""
    play = [h for h in scene.hypotheses if h.name == EFFECT]
    grams = Grams(scene, scene.data, project(scene.data, noise))
    evidence = [float(grams.of_hypothesis(h).evidence(scales_of(h)).max()) for h in play]
    likeliest = play[int(np.argmax(evidence))]
    return fit_set(scene, (Item(likeliest, np.zeros(0), 0.0),), noise).score
