"""What a plan costs at its test poses and elsewhere: the least ρ₀, that with a cap, random plans.

    .venv/bin/python experiment_design/everywhere/study.py [--candidates 2500] [--campaigns 20000]

Every plan is kept in runs/ as it is found, so that an interrupted study goes on; result.md is
written at the end.  The arms' files come with the package example-robot-data.
"""

from __future__ import annotations

import argparse
from importlib import metadata
from pathlib import Path

import numpy as np

from elastocal.cell.arm_description import CartesianNoise, ModelSpec, Nominal, Robot, Tool, Tracker
from elastocal.cell.plan_wishes import DesignSpec, TargetPose
from elastocal.cell.work_cell import Cell
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import draw
from elastocal.planning.exchange import exact_plan, random_information
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.information import plan_forces
from elastocal.planning.plan import Everywhere
from elastocal.planning.relaxation import balanced, relax
from elastocal.planning.setup import Known, set_up, share_within
from elastocal.planning.test_poses import everywhere, test_poses

HERE = Path(__file__).parent
ARMS = {  # file, flange, load in N
    "UR10": ("ur_description/urdf/ur10_robot.urdf", "tool0", 80.0),
    "Panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp", 20.0),
}
EFFECTS = ("base_frame", "joint_offset", "link_geometry", "joint_compliance", "marker_position")
PLANS = {"least ρ₀": 0.0, "cap 5 %": 0.05}
POSES, FRESH = 30, 77  # FRESH: a seed that no plan has seen


def cell_of(arm: str, stated: bool) -> Cell:
    """Three markers, an unloaded and a loaded reading; test poses drawn over the joint ranges, or
    eight stated about one posture."""
    ending, flange, load = ARMS[arm]
    files = metadata.distribution("example-robot-data").files or ()
    path = next(Path(str(f.locate())) for f in files if str(f).endswith(ending))
    n = 7 if arm == "Panda" else 6
    middle = np.radians([0, -30, 0, -120, 0, 100, 45] if n == 7 else [0, -90, 90, 0, 60, 0])
    near = middle + np.random.default_rng(0).uniform(-0.5, 0.5, (8, n))
    return Cell(
        name=arm,
        robot=Robot.from_urdf(path, flange=flange),
        tool=Tool(
            load_point=[0.0, 0.0, 0.1],
            markers={"M1": [0.08, 0, 0.05], "M2": [-0.06, 0.07, 0.06], "M3": [-0.05, -0.08, 0.07]},
        ),
        tracker=Tracker(position=[2.5, -1.5, 1.0], noise=CartesianNoise([15e-6] * 3)),
        model=ModelSpec(
            effects=EFFECTS,
            nominal=Nominal(joint_compliance=(3e-5, 3e-5, 5e-5) + (1e-4,) * (n - 3)),
        ),
        design=DesignSpec(
            poses=POSES,
            repeats=3,
            loads=[[0, 0, 0], [0, 0, -load]],
            test_poses=tuple(TargetPose(q) for q in near) if stated else (),
        ),
    )


def rows_of(arm: str, stated: bool, candidates: int, campaigns: int) -> list[str]:
    """Rms over the campaigns, in µm: noise drawn, through B to the parameters, to the tool."""
    cell = cell_of(arm, stated)
    model = Model(cell)
    chain, forces, rules = model.chain, plan_forces(cell), Feasibility(cell, model.chain)
    poses = draw(cell, chain, forces, rules, candidates, 0)
    targets = test_poses(cell, chain, rules)
    setup, fresh = (
        set_up(
            model, poses.q, POSES, targets, Known(), everywhere(cell, chain, rules, seed)
        )
        for seed in (0, FRESH)
    )  # fmt: skip
    pool, shares = setup.pool(poses.q, poses.group), np.array([POSES])
    assert fresh.target_rows is not None and fresh.elsewhere_rows is not None
    figures = {}
    for k, (name, cap) in enumerate(PLANS.items()):
        file = HERE / "runs" / f"{arm}_{'stated' if stated else 'drawn'}_{k}.npy"
        if not file.exists():
            print(file.stem, flush=True)
            share = share_within(setup, pool, shares, cap, lambda message: None)
            problem, _ = balanced(setup.sharing(share).problem(pool, shares))
            chosen, _ = exact_plan(problem, relax(problem), starts=2)
            file.parent.mkdir(exist_ok=True)
            np.save(file, chosen)
        blocks = pool.blocks[np.load(file)]
        M, B = setup.gathered(blocks), blocks.reshape(-1, blocks.shape[-1])
        noise = np.random.default_rng(1).standard_normal((len(B), campaigns))
        x = np.linalg.solve(M, B.T @ noise)
        figures[name] = [
            float(np.sqrt(((R @ x) ** 2).sum(axis=0).mean()))
            for R in (fresh.target_rows, fresh.elsewhere_rows)
        ]
    drawn = random_information(setup.problem(pool, shares), 0)
    chance = Everywhere.of(fresh.target_rows, fresh.elsewhere_rows, drawn[0], drawn, drawn[0])
    figures["random, median"] = [chance.random_test_poses, chance.random_elsewhere]
    least = figures["least ρ₀"][0]
    where = "eight stated" if stated else "drawn over the joint ranges"
    return [
        f"| {arm} | {where} | {name} | {1e6 * at:.1f} | {100 * (at / least - 1):+.1f} % | "
        f"{1e6 * beyond:.1f} |"
        for name, (at, beyond) in figures.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--candidates", type=int, default=2500)
    parser.add_argument("--campaigns", type=int, default=20_000)
    asked = parser.parse_args()
    lines = [
        "# Result",
        "",
        f"`study.py`, {POSES} poses, {asked.candidates} candidates, {asked.campaigns} campaigns "
        "per plan; rms position error in µm.",
        "",
        "| arm | test poses | plan | at the test poses | over the least | elsewhere |",
        "|---|---|---|---|---|---|",
    ]
    for stated in (False, True):
        for arm in ARMS:
            lines += rows_of(arm, stated, asked.candidates, asked.campaigns)
    (HERE / "result.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
