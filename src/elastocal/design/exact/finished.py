"""Starts that are done, kept so that an interrupted search goes on without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from elastocal.design.problem import DesignProblem, IntArray


class Checkpoint(Protocol):
    """Where named arrays are kept, whole or not at all."""

    def load(self) -> dict[str, NDArray[Any]] | None:
        """What was saved last, None if nothing was."""

    def save(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Keep `state` instead of what was saved before."""


@dataclass(frozen=True)
class Finished:
    """Where a start ended: its plan (n_poses,), sorted, Φ, and the passes it took."""

    chosen: IntArray
    value: float
    passes: int


def save_finished(checkpoint: Checkpoint | None, done: Mapping[int, Finished], seed: int) -> None:
    """Keep all starts `done` so far, by their numbers."""
    if checkpoint is None:
        return
    checkpoint.save(
        {
            "seed": np.array(seed),
            "start": np.array(list(done)),
            "chosen": np.array([f.chosen for f in done.values()]),
            "value": np.array([f.value for f in done.values()]),
            "passes": np.array([f.passes for f in done.values()]),
        }
    )


def load_finished(
    checkpoint: Checkpoint | None, problem: DesignProblem, seed: int, starts: int
) -> dict[int, Finished]:
    """The starts that need not be made again; none where they are of another problem or seed."""
    state = None if checkpoint is None else checkpoint.load()
    if state is None or int(state["seed"]) != seed or not _belongs(state, problem):
        return {}
    numbered = zip(state["start"], state["chosen"], state["value"], state["passes"], strict=True)
    return {
        int(k): Finished(chosen, float(value), int(passes))
        for k, chosen, value, passes in numbered
        if k < starts
    }


def _belongs(state: Mapping[str, NDArray[Any]], problem: DesignProblem) -> bool:
    """Do the saved plans fit the problem, with the values saved with them?"""
    chosen = state["chosen"]
    if chosen.shape[1:] != (problem.n_poses,) or chosen.max(initial=-1) >= problem.n_candidates:
        return False
    for plan, value in zip(chosen, state["value"], strict=True):
        shares = np.bincount(problem.group[plan], minlength=len(problem.shares))
        if not np.array_equal(shares, problem.shares):
            return False
        now = problem.criterion.value(problem.prior + problem.sum_of(plan))
        if not np.isclose(now, value, rtol=1e-9, atol=0):
            return False
    return True
