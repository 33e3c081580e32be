"""Test poses from the cell, a path, a box, or drawn; what does not fit the robot is told."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.calibration import placement
from support.cells import DOWN, kr270_cell, kr270_chain, nominal_flanges, random_poses
from support.design_cells import plan_cell, scara, setup_of

from elastocal.cell import Cell, Solid, Workspace
from elastocal.cell_tables import (
    DesignSpec,
    Motion,
    Nominal,
    TargetBox,
    TargetPath,
    TargetPose,
    Tool,
)
from elastocal.messages import InputError
from elastocal.planning import poses as target_poses
from elastocal.planning.design import check_cell
from elastocal.planning.poses import DEFAULT_COUNT, TargetPoses, joint_space

CHAIN = kr270_chain()
LOADS = np.array([[0.0, 0, 0], [0, 0, -2600], [0, 900, -2600]])
POINT = np.array([0.2, 0.0, 0.25])
LOWER, UPPER = np.array([1.2, -0.3, 0.8]), np.array([1.7, 0.3, 1.3])


def cell_of(tool: Tool | None = None, nominal: Nominal | None = None, **design: Any) -> Cell:
    cell = replace(kr270_cell(), tool=tool or Tool(POINT), design=DesignSpec(**design))
    return replace(cell, model=replace(cell.model, nominal=nominal or Nominal()))


def poses_of(cell: Cell, rules: Any = None, seed: int = 0) -> TargetPoses:
    found = target_poses.test_poses(cell, CHAIN, rules, seed)
    T = len(found.q)
    assert found.q.shape == (T, 6) and found.force.shape == found.point.shape == (T, 3)
    assert found.weight.shape == (T,) and found.weight.sum() == pytest.approx(1.0)
    return found


def places(found: TargetPoses) -> NDArray:
    T = nominal_flanges(CHAIN, found.q)
    return np.einsum("tij,tj->ti", T[:, :3, :3], found.point) + T[:, :3, 3]


def test_stated_poses_come_with_their_force_point_and_share() -> None:
    q = random_poses(CHAIN, 2, seed=1)
    own, force = np.array([0.0, 0.1, 0.0]), np.array([1.0, 2.0, 3.0])
    asked = TargetPose(q[0], force, 3.0, own), TargetPose(q[1])
    found = poses_of(cell_of(loads=LOADS, test_poses=asked))
    np.testing.assert_array_equal(found.q, q[[0, 1, 1]])
    np.testing.assert_array_equal(found.force, [force, *LOADS[1:]])
    np.testing.assert_allclose(found.weight, [0.75, 0.125, 0.125])
    np.testing.assert_array_equal(found.point, [own, POINT, POINT])
    assert "2 of [[design.test_pose]]" in found.source


def path_cell(folder: Path, text: str, nominal: Nominal | None = None, **options: Any) -> Cell:
    file = folder / "path.csv"
    file.write_text(text, encoding="utf-8")
    return cell_of(nominal=nominal, test_path=TargetPath(file, **options))


def csv(header: str, rows: NDArray) -> str:
    return "\n".join([header, *(",".join(repr(float(v)) for v in row) for row in rows)]) + "\n"


JOINTS = ",".join(f"q{i}_deg" for i in range(1, 7))


@pytest.mark.parametrize("turned", ["free", "quaternion"])
def test_a_path_of_places_is_reached_where_the_arm_stands(tmp_path: Path, turned: str) -> None:
    T = placement([0.5, -2.0, 0.3], Rotation.from_euler("z", 2.0))
    flange = T @ nominal_flanges(CHAIN, random_poses(CHAIN, 8, seed=3))
    position = flange[:, :3, :3] @ POINT + flange[:, :3, 3]
    rotation = Rotation.from_matrix(flange[:, :3, :3])
    header, columns = "x_mm,y_mm,z_mm", [position * 1e3]
    if turned == "quaternion":
        w_first = np.roll(rotation.as_quat(), 1, axis=1)
        header, columns = header + ",qw,qx,qy,qz", [*columns, w_first]
    nominal = Nominal(base_position=T[:3, 3], base_rotation=T[:3, :3])
    found = poses_of(path_cell(tmp_path, csv(header, np.hstack(columns)), nominal))
    np.testing.assert_allclose(places(found) @ T[:3, :3].T + T[:3, 3], position, atol=2e-6)
    if turned != "free":
        reached = Rotation.from_matrix(T[:3, :3] @ nominal_flanges(CHAIN, found.q)[:, :3, :3])
        assert (reached.inv() * rotation).magnitude().max() < 2e-6


GOOD = "0,-90,90,0,30,0"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"{JOINTS},weight\n{GOOD},1\n{GOOD},0", ["line 3, column weight", "must be positive"]),
        ("weight\n1", ["q1_deg … or x_mm,y_mm,z_mm are missing"]),
        (f"{JOINTS},x_mm,y_mm,z_mm\n{GOOD},1,1,1", ["two ways", "keep the joints or"]),
        ("x_mm,y_mm,z_mm,repeat\n1,1,1,1", ["'repeat' has no meaning in a path"]),
        (JOINTS + f"\n{GOOD}" * 10_001, ["10001 poses; a path takes at most 10000"]),
        ("x_m,y_m,z_m\n1500,0,1000", ["line 2", "out of reach", "no nearer than 1799", "unit?"]),
    ],
)
def test_what_is_wrong_with_a_path_is_told_with_its_place(
    tmp_path: Path, text: str, told: list[str]
) -> None:
    with pytest.raises(InputError) as caught:
        poses_of(path_cell(tmp_path, text))
    message = str(caught.value)
    assert "path.csv" in message
    assert not [part for part in told if part not in message], message


def test_a_box_is_filled_with_reached_places() -> None:
    found = poses_of(cell_of(test_box=TargetBox(LOWER, UPPER, 32)))
    at = places(found)
    assert len(at) == 32 and (at >= LOWER - 2e-6).all() and (at <= UPPER + 2e-6).all()
    # Sobol points: every half of every edge holds half of them.
    assert ((at > (LOWER + UPPER) / 2).sum(axis=0) == 16).all()


@dataclass(frozen=True)
class Elbow:
    """Allows joint 3 on one side of `least` only, and the named force at most."""

    least: float
    forces: tuple[float, ...] = (0.0, -2600.0)

    def check(self, q: NDArray, force: NDArray, every: bool = True) -> Any:
        assert force.shape == (len(q), 3)
        return SimpleNamespace(ok=(q[:, 2] > self.least) & np.isin(force[:, 2], self.forces))


class Wrist:
    """Allows joint 6 in a narrow range: one posture in forty."""

    def check(self, q: NDArray, force: NDArray, every: bool = True) -> Any:
        return SimpleNamespace(ok=np.abs(q[:, 5] - 3.0) < 0.15)


def test_a_rare_posture_that_the_cell_allows_is_found_by_plan_and_identification(monkeypatch):
    monkeypatch.setattr(target_poses, "at_work", lambda *asked: Wrist())
    cell = cell_of(test_box=TargetBox(LOWER, UPPER, 8))
    for found in poses_of(cell, Wrist()), target_poses.used_poses(cell, CHAIN):
        assert Wrist().check(found.q, found.force).ok.all()
        np.testing.assert_allclose(places(found), places(poses_of(cell)), atol=4e-6)


def test_places_without_an_allowed_posture_are_told(tmp_path: Path) -> None:
    box = TargetBox(LOWER, UPPER, 8)
    found = poses_of(cell_of(test_box=box), Elbow(100.0))
    other_load = poses_of(cell_of(loads=LOADS, test_box=box), Elbow(-9.0, ()))
    path = poses_of(path_cell(tmp_path, csv("x_mm,y_mm,z_mm", 1e3 * places(found))), Elbow(100.0))
    for told in found, other_load, path:
        assert "(8 of them in no posture that the work cell allows" in told.source
    assert path.source.endswith(", line 8, line 9)")


def test_without_any_source_poses_are_drawn_over_the_limits_and_it_is_said() -> None:
    cell = replace(cell_of(loads=LOADS[:2]), limits={"joint1": (-0.5, 0.5)})
    found = poses_of(cell)
    assert len(found.q) == DEFAULT_COUNT
    assert -0.5 <= found.q[:, 0].min() < -0.3 and 0.3 < found.q[:, 0].max() <= 0.5
    np.testing.assert_array_equal(found.force, np.tile(LOADS[1], (DEFAULT_COUNT, 1)))
    assert f"{DEFAULT_COUNT} drawn over the joint limits (the cell states none)" in found.source
    np.testing.assert_array_equal(poses_of(cell).q, found.q)
    assert (poses_of(cell, seed=1).q != found.q).any()


def test_several_sources_add_up(tmp_path: Path) -> None:
    q = random_poses(CHAIN, 3, seed=2)
    cell = path_cell(tmp_path, csv(JOINTS, np.degrees(q)))
    pose = TargetPose(q[0], weight=5.0)
    box = TargetBox(LOWER, UPPER, 2)
    cell = replace(cell, design=replace(cell.design, test_poses=(pose,), test_box=box))
    found = poses_of(cell)
    np.testing.assert_allclose(found.q[:4], q[[0, 0, 1, 2]], rtol=1e-14)
    np.testing.assert_allclose(found.weight, [0.5, *[0.1] * 5])
    for part in ("1 of [[design.test_pose]]", "3 of path.csv", "2 in [design.test_box]"):
        assert part in found.source


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
        (
            cell(model={"compliance_levels": {"joint2": (-1.0,)}}, levels={"joint2": (-0.9,)}),
            ["none of its levels in [model.compliance_levels]", "-51.5662°"],
        ),
        (cell(motion=Motion(home=HOME[:5])), ["design.motion.home_si has 5 numbers", "give 6"]),
        (cell(motion=Motion(home=HIGH)), ["design.motion.home_si: joint2", "at 10°", "to 0°"]),
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


def test_degrees_do_not_fit_a_prismatic_joint() -> None:
    chain = scara()
    for bad, told in (
        ({"test_poses": (TargetPose(HOME[:4], degrees=True),)}, "q_deg of .* use q_si of"),
        ({"motion": Motion(home=HOME[:4], degrees=True)}, "home_deg .* use .*home_si"),
        ({"motion": Motion(speed=np.ones(4), degrees=True)}, "speed_deg_per_s .* use .*speed_si"),
    ):
        told = told.replace(" use ", r" joint3 \(q3\) is prismatic; use ")
        with pytest.raises(InputError, match=told):
            check_cell(cell(**bad), chain)
            target_poses.test_poses(cell(**bad), chain)
