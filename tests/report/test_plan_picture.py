"""The picture of poses: what is drawn is where the arm stands."""

import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import TABLE_2, kr270_cell, kr270_chain, nominal_flanges, random_poses

from elastocal.cell.arm_description import Nominal, Tracker
from elastocal.cell.work_cell import HalfSpace, Solid, Workspace
from elastocal.report.arm_view import plan_figure, write_plan_picture

PLACED = np.eye(4)
PLACED[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
PLACED[:3, 3] = 1.0, -2.0, 0.5
SOLIDS = (
    Solid("crate", "box", np.array([0.5, 0.8, 1.2]), PLACED),
    Solid("ball", "sphere", np.array([0.4]), PLACED),
    Solid("pillar", "cylinder", np.array([0.2, 3.0]), PLACED),
    Solid("post", "capsule", np.array([0.15, 1.0]), PLACED),
)
LEVELS = sorted(set(TABLE_2[:, 1]), reverse=True)
NAMES = [str(i + 1) for i in range(15)]


@pytest.fixture(scope="module")
def cell():
    workspace = Workspace(
        SOLIDS, keep_out=(HalfSpace("floor", np.zeros(3), np.array([0, 0, 1.0])),)
    )
    base = Nominal(base_position=np.array([0.3, 0.2, 0.1]), base_rotation=PLACED[:3, :3])
    cell = kr270_cell(nominal=base)
    return replace(cell, workspace=workspace, tracker=Tracker(np.array([4.0, 1.0, 1.2])))


def plan_at(cell, q, group, group_names, names=None):
    """What a picture takes of a plan."""
    stops = [SimpleNamespace(pose=k, again=0) for k in range(len(q))]
    return SimpleNamespace(
        model=SimpleNamespace(cell=cell, chain=kr270_chain()), q=q, group=np.asarray(group),
        group_names=tuple(group_names), configurations=names or [str(i + 1) for i in range(len(q))],
        level_joint=1, execution=SimpleNamespace(stops=stops),
    )  # fmt: skip


def of_table_2(cell):
    level = [int(np.argmin(np.abs(np.subtract(LEVELS, v)))) for v in TABLE_2[:, 1]]
    return plan_at(cell, TABLE_2, level, [f"q2 = {np.degrees(v):.2f}°" for v in LEVELS])


def tips(axes):
    return [line for line in axes.lines if str(line.get_label()).startswith(("q2", "g"))]


def test_flanges_are_drawn_where_the_model_puts_them_in_every_view(cell):
    figure = plan_figure(of_table_2(cell))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cell.model.nominal.base_rotation, cell.model.nominal.base_position
    expected = (T @ nominal_flanges(kr270_chain(), TABLE_2))[:, :3, 3]
    _, top, side = figure.axes
    for axes, pick in ((top, [0, 1]), (side, [0, 2])):
        drawn = np.concatenate([line.get_xydata() for line in tips(axes)])
        order = np.argsort([LEVELS.index(v) for v in TABLE_2[:, 1]], kind="stable")
        assert len(tips(axes)) == len(LEVELS) and np.allclose(drawn, expected[order][:, pick])
    told = {t.get_text() for t in top.texts}
    assert told >= {*NAMES, *(solid.name for solid in SOLIDS), "tracker"}
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == [line.get_label() for line in tips(top)]


def test_names_from_files_are_not_formulas_and_sixty_poses_are_drawn(cell, tmp_path):
    q = random_poses(kr270_chain(), 60, 0)
    names = [f'${i}_<&"' for i in range(60)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = plan_at(cell, q, np.zeros(60, int), ["no load $x^$"], names)
        write_plan_picture(tmp_path / "plan.svg", plan)
    ET.parse(tmp_path / "plan.svg")
