"""What the cell asks of a plan is held against the robot: numbers of joints, units, limits."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.calibration import random_chain
from support.cells import DOWN, kr270_cell, kr270_chain, random_poses
from support.design_cells import plan_cell, setup_of
from support.robots import KR270

from elastocal.cell.plan_wishes import DesignSpec, Motion, TargetPose
from elastocal.cell.work_cell import Cell, Solid, Workspace, read_cell
from elastocal.errors import InputError
from elastocal.planning import test_poses as target_poses
from elastocal.planning.candidates import joint_space
from elastocal.planning.test_poses import check_cell

HOME = np.radians([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])
HIGH = np.radians([0.0, 10.0, 90.0, 0.0, 0.0, 0.0])  # joint 2 ends at 0°
BALL = Solid("ball", "sphere", np.array([0.1]))


def cell(workspace: Workspace | None = None, model: Any = None, **design: Any) -> Cell:
    found = kr270_cell()
    spec = found.model if model is None else replace(found.model, **model)
    return replace(
        found, workspace=workspace or Workspace(), design=DesignSpec(**design), model=spec
    )


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (cell(levels={"joint2": (-1.0, 0.2)}), ["joint2 at 11.4592°", "-146° to 0°"]),
        (
            cell(model={"compliance_levels": {"joint2": (-1.0,)}}, levels={"joint2": (-0.9,)}),
            ["none of its levels in [model.compliance_levels]", "-51.5662°"],
        ),
        (cell(motion=Motion(home=HOME[:5])), ["design.motion.home_si has 5 numbers", "give 6"]),
        (cell(motion=Motion(home=HIGH)), ["design.motion.home_si: joint2", "at 10°", "to 0°"]),
        (cell(motion=Motion(speed=np.ones(1))), ["design.motion.speed_si has 1 numbers"]),
        (
            cell(motion=Motion(speed=np.ones(2), degrees=True)),
            ["design.motion.speed_deg_per_s has 2 numbers", "or one for all"],
        ),
        (
            cell(test_poses=(TargetPose(HOME), TargetPose(HIGH, degrees=True))),
            ["q_deg of [[design.test_pose]] no. 2: joint2", "at 10°", "correct the posture"],
        ),
    ],
)
def test_what_does_not_fit_is_told_with_key_found_and_remedy(bad: Cell, told: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        check_cell(bad, kr270_chain())
        target_poses.test_poses(bad, kr270_chain())
    assert not [part for part in told if part not in str(caught.value)], str(caught.value)


def test_a_compliance_known_at_levels_asks_test_poses_and_plan_to_keep_to_them() -> None:
    levels = {"compliance_levels": {"joint2": (-1.0, 0.0)}}
    off = plan_cell(
        model=levels, levels={"joint2": (-1.0,)}, loads=DOWN[None], test_poses=(TargetPose(HOME),)
    )
    q = random_poses(kr270_chain(), 30, seed=1)
    q[:, 1] = -1.0
    with pytest.raises(InputError, match=r"test pose 1: joint2 at -90° is none of its .*, 0°"):
        setup_of(off, q)
    with pytest.raises(InputError, match=r"levels\] joint2_deg = .* instead of joint3"):
        joint_space(cell(model=levels, levels={"joint3": (0.0,)}), kr270_chain())


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (cell(test_poses=(TargetPose(HOME, degrees=True),)), "q_deg of .* use q_si of"),
        (cell(motion=Motion(home=HOME, degrees=True)), "home_deg gives degrees.* use .*home_si"),
        (cell(motion=Motion(speed=np.ones(6), degrees=True)), "speed_deg_per_s .* use .*speed_si"),
    ],
)
def test_degrees_do_not_fit_a_prismatic_joint(bad: Cell, told: str) -> None:
    chain = random_chain(seed=1)
    slide = replace(chain.joints[2], kind="prismatic")
    chain = replace(chain, joints=(*chain.joints[:2], slide, *chain.joints[3:]))
    with pytest.raises(InputError, match=rf"joint3 \(q3\) is prismatic|{told}") as caught:
        check_cell(bad, chain)
        target_poses.test_poses(bad, chain)
    assert "prismatic" in str(caught.value)


def test_the_cell_shown_in_the_documentation_fits_its_robot(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "file-formats.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml(?: workspace| design)?\n(.*?)```", page, re.S)
    assert len(blocks) == 3
    (tmp_path / "arm.urdf").write_bytes(KR270.read_bytes())
    (tmp_path / "fixture.stl").write_text("read by the collision check", encoding="utf-8")
    joints = ",".join(f"q{i}_deg" for i in range(1, 7))
    (tmp_path / "path.csv").write_text(f"{joints}\n0,-90,90,0,30,0\n", encoding="utf-8")
    (tmp_path / "cell.toml").write_text("\n".join(blocks), encoding="utf-8")
    shown = read_cell(tmp_path / "cell.toml")
    check_cell(shown, kr270_chain())
    targets = target_poses.test_poses(shown, kr270_chain())
    assert len(targets.q) == 1 + 1 + 20
