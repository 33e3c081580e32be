"""Load states chosen with the poses against every pose in every load state, in the same minutes.

    .venv/bin/python experiment_design/load_states/study.py

prints a row per cell, and what unequal numbers of readings could gain, which result.md has.  The
UR10's file comes with the package example-robot-data; the KR 270 is that of
../kr270_plan/crowded.toml without its obstacles.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import numpy as np

import elastocal as ec
from elastocal.cell import Cell, Workspace
from elastocal.cell_tables import (
    CartesianNoise,
    DesignSpec,
    ModelSpec,
    Nominal,
    Robot,
    TargetPose,
    Tool,
    Tracker,
)
from elastocal.model.manipulator import Model
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import Known, plan_forces
from elastocal.planning.poses import draw, test_poses
from elastocal.planning.relaxation import relax
from elastocal.planning.setup import set_up, single_ways

HERE = Path(__file__).parent
EFFECTS = ("base_frame", "joint_offset", "link_geometry", "joint_compliance", "marker_position")
HEADS = ("cell", "loads", "crossed", "chosen", "lower by", "relaxed", "minutes", "poses per load")


def cells() -> dict[str, tuple[Cell, int]]:
    """By name, each with its number of poses."""
    kr270 = replace(
        ec.read_cell(HERE.parent / "kr270_plan" / "crowded.toml"), workspace=Workspace()
    )
    ur10 = _ur10()
    paper = ec.read_cell(HERE.parent / "kr270_plan" / "joint_limits.toml")
    return {
        "UR10": (ur10, 20),
        "UR10, half the load too": (_with_half(ur10), 20),
        "KR 270": (kr270, 15),
        "KR 270, half the load too": (_with_half(kr270), 15),
        "KR 270, deflections": (paper, 15),
    }


def _ur10() -> Cell:
    """Three markers, 80 N at most, eight test poses about one posture."""
    files = metadata.distribution("example-robot-data").files or ()
    path = next(Path(str(f.locate())) for f in files if str(f).endswith("urdf/ur10_robot.urdf"))
    middle = np.radians([0, -90, 90, 0, 60, 0])
    near = middle + np.random.default_rng(0).uniform(-0.5, 0.5, (8, 6))
    return Cell(
        name="UR10",
        robot=Robot.from_urdf(path, flange="tool0"),
        tool=Tool(
            load_point=[0.0, 0.0, 0.1],
            markers={"M1": [0.08, 0, 0.05], "M2": [-0.06, 0.07, 0.06], "M3": [-0.05, -0.08, 0.07]},
        ),
        tracker=Tracker(position=[2.5, -1.5, 1.0], noise=CartesianNoise([15e-6] * 3)),
        model=ModelSpec(
            effects=EFFECTS, nominal=Nominal(joint_compliance=(3e-5, 3e-5, 5e-5, 1e-4, 1e-4, 1e-4))
        ),
        design=DesignSpec(
            repeats=3, loads=[[0, 0, 0], [0, 0, -80]], test_poses=tuple(map(TargetPose, near))
        ),
    )


def _with_half(cell: Cell) -> Cell:
    loads = cell.design.loads
    assert loads is not None
    return replace(cell, design=replace(cell.design, loads=np.insert(loads, 1, loads[-1] / 2, 0)))


def row_of(name: str, cell: Cell, poses: int) -> str:
    crossed, chosen = (
        ec.design(
            cell, poses=poses, per_level=(), elsewhere=0.0, candidates=500, effort="quick",
            load_states=states,
        )
        for states in ("all", "chosen")
    )  # fmt: skip
    states = chosen.states
    assert states is not None
    relaxed = "–"
    if states.crossed is not None and states.chosen is not None:
        relaxed = f"{100 * (1 - states.chosen / states.crossed):.1f} %"
    took = " / ".join(f"{plan.execution.total / 60:.0f}" for plan in (crossed, chosen))
    told = " + ".join(map(str, (chosen.readings > 0).sum(axis=0))) if not states.why else states.why
    figures = f"{crossed.reported:.3f} | {chosen.reported:.3f}"
    lower = f"{100 * (1 - chosen.reported / crossed.reported):.1f} %"
    return f"| {name} | {len(crossed.forces)} | {figures} | {lower} | {relaxed} | {took} | {told} |"


def unequal(cell: Cell, poses: int, times: int = 3) -> float:
    """By how much the relaxed ρ₀ falls where a pose may be read up to so many times as often as
    others, with as many readings in all."""
    model = Model(cell)
    rules = Feasibility(cell, model.chain)
    q = draw(rules, plan_forces(cell), 1000, 0)
    setup = set_up(model, q.q, poses, test_poses(cell, model.chain, rules, 0), Known())
    setup = replace(setup, ways=single_ways(setup.information))
    problem = setup.problem(setup.pool(q.q, q.group), np.array([poses])).balanced()
    once = relax(problem, 1e-3)
    some = problem.restricted(np.argsort(-once.weights)[:400])
    blocks, group = np.tile(some.blocks, (times, 1, 1)), np.tile(some.group, times)
    often = relax(replace(some, blocks=blocks, group=group), 1e-3)
    return float(1 - np.sqrt(often.value / once.value))


if __name__ == "__main__":
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
    for name, (cell, poses) in cells().items():
        if len(sys.argv) < 2 or name in sys.argv[1:]:
            print(row_of(name, cell, poses), flush=True)
    for name in ("UR10", "KR 270"):
        print(f"\n{name}: unequal readings, {100 * unequal(*cells()[name]):.1f} % lower at best")
