"""An execution as a list of what a robot program does: move, have the load changed, measure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.execution import Execution
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain

Array = NDArray[np.float64]

AXES = 6


@dataclass(frozen=True)
class Move:
    """A joint move to `q` (n,) rad; `note` says what is there."""

    q: Array
    note: str


@dataclass(frozen=True)
class ChangeLoad:
    """A stop until someone has done what `order` says."""

    order: str


@dataclass(frozen=True)
class Measure:
    """A stop of `dwell` s while the tracker measures `note`."""

    dwell: float
    note: str


Step = Move | ChangeLoad | Measure


def steps_of(
    execution: Execution, configurations: Sequence[str], forces: Array | None = None
) -> Iterator[Step]:
    """Every step in order, beginning and ending at home where there is one.

    `configurations`: a name per pose; `forces` (L, 3) N per load state, None: no load at all.
    """
    loads = ["no load"] if forces is None else [load_name(force) for force in forces]
    loaded = [False] if forces is None else [bool(np.any(force)) for force in forces]
    home = execution.motion.home
    if home is not None:
        yield Move(home, "home")
    for stop in execution.stops:
        name = f"configuration {configurations[stop.pose]}"
        done = 0
        for q in [*stop.via, stop.q]:
            if stop.change_after == done:
                yield _change(loaded[stop.load], loads[stop.load])
            yield Move(q, name if q is stop.q else "via point, not measured")
            done += 1
        if stop.change_after == done:
            yield _change(loaded[stop.load], loads[stop.load])
        side = "" if stop.approach is None else f", approached from {('below', 'above')[stop.side]}"
        yield Measure(execution.motion.dwell, f"{name}, {loads[stop.load]}{side}")
    if execution.take_off:
        yield _change(False, "no load")
    if home is not None:
        for q in execution.home_via:
            yield Move(q, "via point, not measured")
        yield Move(home, "home")


def load_name(force: Array) -> str:
    """The load state in words: its force in N in the data's frame."""
    if not np.any(force):
        return "no load"
    return "load of ({:g}, {:g}, {:g}) N".format(*np.asarray(force, dtype=float) + 0.0)


def check_six_axes(chain: Chain, language: str) -> None:
    """Raise InputError unless the arm has six revolute joints, which is what `language` moves."""
    sliding = [joint.name for joint in chain.joints if joint.kind != "revolute"]
    if chain.n_joints != AXES or sliding:
        what = f"joint {', '.join(sliding)} slides" if sliding else f"it has {chain.n_joints}"
        raise InputError(
            f"robot '{chain.name}': a {language} program moves arms of {AXES} revolute joints, but "
            f"{what}; external axes are not written: take the joint values from the plan's table"
        )


def _change(hang: bool, name: str) -> ChangeLoad:
    return ChangeLoad(f"hang the {name}" if hang else "take the load off")
