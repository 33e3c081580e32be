"""How the effects of a whole arm act: several at every joint, in laws of their own words.

Names are not those of elastocal, which is asked for sizes and causes here, not for a name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from inside import POSE
from numpy.typing import NDArray
from skeleton import Skeleton
from world import Effect, Hooks, Motion, Visits

Array = NDArray[np.float64]
LINES, WEIGHTS, LAST_MOVE, CREEP = "gear_lines", "unknown_weights", "last_move", "slow_creep"


def gear_error(e: Effect, q: Array) -> Array:
    """Error (n,) rad of a gear at its joint's angle q (n,): lines of any order, each
    a sin(order q) + b cos(order q)."""
    error = np.zeros(len(q))
    for line, order in e.settings.items():
        a, b = e.vector(f"{line}_sin", f"{line}_cos")
        error += a * np.sin(order * q) + b * np.cos(order * q)
    return error


def last_move(e: Effect, approach: Array) -> Array:
    """Where a joint stops (n,) rad: beyond its target, or before it, by the side it came from."""
    return e.values["half_width"] * approach


def creep(e: Effect, time: Array) -> Array:
    """Shift and turn of the base (n, 6) m, rad: waves whose frequencies are drawn from the
    spectrum of a Gaussian process of squared exponential covariance."""
    moved = np.zeros((len(time), 6))
    frequencies = [w for key, w in e.settings.items() if key.startswith("frequency")]
    for k, frequency in enumerate(frequencies):
        for wave, name in ((np.cos, "cos"), (np.sin, "sin")):
            size = e.vector(*[f"{axis}_{name}{k}" for axis in POSE])
            moved += np.outer(wave(frequency * time), size)
    return moved


def _gear(e: Effect, v: Visits, m: Motion) -> None:
    m.drive[:, e.index] += gear_error(e, v.q[:, e.index])


def _last_move(e: Effect, v: Visits, m: Motion) -> None:
    m.drive[:, e.index] += last_move(e, v.approach[:, e.index])


def _creep(e: Effect, v: Visits, m: Motion) -> None:
    m.base += creep(e, v.time)


def weights(e: Effect) -> tuple[Array, Array]:
    """Masses (J,) kg of the links and their centres (J, 3) m in the joints' frames."""
    J = len(e.values) // 4
    masses = e.vector(*[f"mass{j + 1}" for j in range(J)])
    centres = [e.vector(*[f"com{j + 1}_{axis}" for axis in "xyz"]) for j in range(J)]
    return masses, np.array(centres)


def _weigh(e: Effect, skeleton: Skeleton) -> Skeleton:
    masses, centres = weights(e)
    return replace(skeleton, mass=masses, com=centres)


WHOLE: dict[str, Hooks] = {
    LINES: Hooks(move=_gear),
    WEIGHTS: Hooks(weigh=_weigh),
    LAST_MOVE: Hooks(move=_last_move),
    CREEP: Hooks(move=_creep),
}
