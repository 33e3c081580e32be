"""Does a plan keep what it says under each of the nine kinds of noise?

    python experiment_design/arm_coverage/planned.py CAMPAIGNS [SCENARIO …]

A plan for each kind of noise in campaigns.py (quick effort; the noise stated in the cell as far as
it can be), then CAMPAIGNS campaigns of it, linear about the nominal arm: readings in the order and
at the times of the plan, noise drawn anew, faulty readings set apart, the noise model chosen and
its variances estimated as `identify` does.  Prints the rms error at the cell's test poses over the
one that the plan promises, and the noise of single readings over the stated one, where the stated
one is found to be of the right kind.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from importlib.resources import files

import campaigns
import numpy as np

from elastocal.cell.arm_description import CartesianNoise, PolarNoise, Robot, Unsteadiness
from elastocal.cell.plan_wishes import DesignSpec, Motion
from elastocal.cell.work_cell import Cell
from elastocal.cell.workspace_rules import Workspace
from elastocal.identification.noise_choice import linearised
from elastocal.identification.noise_judge import outlier_screening, settle
from elastocal.measurements import Measurements, with_moves
from elastocal.model.observations import observe
from elastocal.planning import test_poses as target_poses
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.plan import Plan
from elastocal.simulation.simulate import simulate

MARKS = len(campaigns.MARKERS)
LASTING = 720.0  # s: about a fifth of a plan
MOTION = Motion(speed=np.full(6, 0.5), dwell=20.0, load_change=120.0)
SIZES = {
    "axes": CartesianNoise(campaigns.SIGMA * np.array([0.5, 1.0, 2.0])),
    "tails": CartesianNoise(np.full(3, np.sqrt(3) * campaigns.SIGMA)),  # their rms
    "polar": PolarNoise(*campaigns.RANGE, *campaigns.TRANSVERSE),
}


def cell_of(scenario: campaigns.Scenario) -> Cell:
    """The arm's cell with the noise stated; 20 µm where the kind is not one that can be."""
    cell, key = campaigns.arm().cell, scenario.key
    spec = DesignSpec(
        poses=scenario.configurations, loads=campaigns.LOADS, candidates=200, elsewhere=0.0,
        motion=MOTION,
    )  # fmt: skip
    unsteady = Unsteadiness(
        np.array([campaigns.SCATTER if key == "joints" else 0.0]),
        campaigns.DRIFT if key == "drift" else 0.0, LASTING,
        campaigns.EFFECT if key == "effect" else 0.0, 3.0 if key == "tails" else None,
    )  # fmt: skip
    urdf = str(files("elastocal.demo") / "kr270_2.urdf")
    return replace(
        cell, robot=Robot.from_urdf(urdf, base="base_link", flange="flange"), design=spec,
        tracker=replace(cell.tracker, noise=SIZES.get(key, cell.tracker.noise)), noise=unsteady,
        workspace=Workspace(mounting_plane=False),
    )  # fmt: skip


def table_of(plan: Plan) -> Measurements:
    """The rows of the plan in the order and at the times of its visits."""
    visits = plan.execution.stops
    change = [MOTION.load_change * (stop.change_after is not None) for stop in visits]
    travel = np.array([stop.travel for stop in visits])
    time = np.cumsum(travel + MOTION.dwell + np.concatenate([[0.0], change[1:]]))
    stops = [stop for stop in visits for _ in range(MARKS)]
    n = len(stops)
    return with_moves(
        Measurements(
            source="plan", row=np.arange(n) + 2, q=np.array([s.q for s in stops]),
            configuration=np.array([s.pose for s in stops]),
            configuration_labels=tuple(map(str, range(1, len(plan.q) + 1))),
            repeat=np.zeros(n, dtype=np.int64), marker=np.arange(n) % MARKS,
            marker_names=tuple(campaigns.MARKERS),
            force=campaigns.LOADS[[s.load for s in stops]],
            time=np.repeat(time, MARKS),
        )
    )  # fmt: skip


class Planned(campaigns.Campaign):
    """Campaigns of a plan; `drawn` makes their noise."""

    def __init__(self, scenario: campaigns.Scenario, plan: Plan) -> None:
        self.scenario, self.rng = scenario, np.random.default_rng(sum(scenario.key.encode()))
        self.true = plan.model.nominal
        self.exact = simulate(plan.model, table_of(plan), self.true, self.rng, False)
        campaigns.LASTING = LASTING / np.ptp(self.exact.time)


def errors_at(plan: Plan, kept: np.ndarray) -> np.ndarray:
    """∂(position at the test poses)/∂(kept), weighted so that |A x|² is the mean square error."""
    model = plan.model
    targets = target_poses.test_poses(model.cell, model.chain)
    pose, n = np.repeat(np.arange(len(targets.q)), MARKS), len(targets.q) * MARKS
    table = replace(
        table_of(plan).take(np.zeros(n, dtype=np.int64)), q=targets.q[pose],
        force=targets.force[pose], marker=np.arange(n) % MARKS, position=np.zeros((n, 3)),
        move=None, direction=None,
    )  # fmt: skip
    B = model.regressor(table, model.nominal, kept).B.reshape(n, 3, -1)
    share = np.sqrt(targets.weight[pose] / MARKS)
    return (share[:, None, None] * B).reshape(3 * n, -1)


def main(number: int, keys: list[str]) -> None:
    print("| noise | promised, µm | realised / promised | noise found / stated | kinds found |")
    print("|" + "---|" * 5)
    for scenario in campaigns.SCENARIOS:
        if keys and scenario.key not in keys:
            continue
        plan = design(cell_of(scenario), DesignOptions(effort="quick"))
        model, campaign = plan.model, Planned(scenario, plan)
        kept = np.array([model.names.index(p.name) for p in plan.predicted])
        readings = linearised(model, observe(campaign.exact, model.observe), model.nominal, kept)
        A, squares, kinds, factors = errors_at(plan, kept), [], Counter(), []
        for _ in range(number):
            one = replace(readings, e=campaign.drawn(campaign.exact)[0])
            found = settle(one, "auto", outlier_screening(one, one.e)).noise
            squares.append(float(((A @ found.x) ** 2).sum()))
            kinds[found.kind] += 1
            if found.kind.startswith("stated"):
                factors.append(found.fit.own[0])
        mean, promised = np.mean(squares), plan.everywhere.drifting_test_poses
        ratio = np.sqrt(mean) / promised
        spread = ratio * np.std(squares) / mean / 2 / np.sqrt(number)
        factor = f"{np.sqrt(np.mean(factors)):.3f}" if factors else "none"
        most = ", ".join(f"{k} {n}" for k, n in kinds.most_common(3))
        print(
            f"| {scenario.name} | {promised * 1e6:.1f} | {ratio:.3f} ± {spread:.3f} | {factor} | "
            f"{most} |",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
