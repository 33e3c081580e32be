"""The posed arm in 3-D and as a picture: where it stands, its arrows, what a page holds of it."""

from __future__ import annotations

import json
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.cells import TABLE_2, kr270_cell, kr270_chain, nominal_flanges, random_poses
from support.robots import packaged_urdf

from elastocal.cell import HalfSpace, Solid, Workspace
from elastocal.cell_tables import Nominal, Robot, Tracker
from elastocal.model.manipulator import load_chain
from elastocal.report.arm_view import (
    in_script,
    plan_arm,
    residual_arm,
    shells_of,
    triangles_of,
    write_plan_picture,
)
from elastocal.report.figures import figure_of

PLACED = np.eye(4)
PLACED[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
PLACED[:3, 3] = 1.0, -2.0, 0.5
BALL = 4 / 3 * np.pi
SOLIDS = {
    "box": (np.array([0.5, 0.8, 1.2]), 0.48),
    "sphere": (np.array([0.4]), BALL * 0.4**3),
    "cylinder": (np.array([0.2, 3.0]), np.pi * 0.2**2 * 3.0),
    "capsule": (np.array([0.15, 1.0]), np.pi * 0.15**2 * 1.0 + BALL * 0.15**3),
}
LEVELS = sorted(set(TABLE_2[:, 1]), reverse=True)


@pytest.mark.parametrize("shape", SOLIDS)
def test_triangles_close_the_solid_from_outside(shape: Any) -> None:
    size, volume = SOLIDS[shape]
    points, faces = triangles_of(Solid(shape, shape, size, PLACED))
    a, b, c = (points[faces[:, k]] - PLACED[:3, 3] for k in range(3))
    # Divergence theorem: positive only where all triangles turn outwards.
    enclosed = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
    assert 0.85 * volume <= enclosed <= 1.0001 * volume
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert there == {(j, i) for i, j in there}
    assert len(there) == len(edges)


@given(st.lists(st.text() | st.integers(), max_size=4))
@settings(max_examples=60, deadline=None)
def test_no_name_ends_the_script_that_holds_it(content: Any) -> None:
    text = in_script([content, "</script><script>", "<!--", "]]>", "&amp;"])
    assert not set("<>&") & set(text)
    assert json.loads(text)[0] == content


def test_arrows_are_mean_residuals_by_configuration_load_and_marker(case: Any) -> None:
    result = case.result
    space = residual_arm(result.model, result.observations, result.x, result.residual).space
    observed = result.observations
    table = observed.table
    parts = result.residual.reshape(-1, 3)
    loaded = (table.force[observed.lead] != 0).any(axis=1)
    assert len(space.poses) == 2 * len(np.unique(observed.configuration))
    pose = space.poses[1]
    label, _, load = pose.name.partition(", ")
    code = table.configuration_labels.index(label)
    here = (observed.configuration == code) & (loaded == (load != "unloaded"))
    for name, marker, arrow in zip(pose.names, pose.markers, pose.arrows, strict=True):
        own = here & (table.marker[observed.lead] == table.marker_names.index(name))
        assert arrow == pytest.approx(parts[own].mean(axis=0))
        assert marker == pytest.approx(table.position[observed.lead][own].mean(axis=0))
    # The arm ends where the model puts the flange.
    row = observed.lead[here][:1]
    assert pose.flange == pytest.approx(result.model.flange_poses(table.take(row), result.x)[0])
    sizes = [np.sqrt((p.arrows**2).sum(axis=1).mean()) for p in space.poses]
    assert space.first == int(np.argmax(sizes))
    content = json.loads(space.json)
    assert len(content["poses"]) == len(space.poses)
    assert content["scale"] == space.scale


def test_a_urdf_with_collision_meshes_at_hand_is_drawn_from_them() -> None:
    urdf, flange = packaged_urdf("UR5")
    cell = replace(kr270_cell(), robot=Robot(urdf=urdf, flange=flange))
    chain = load_chain(cell)
    arm, *_, drawn_from = shells_of(cell, chain)
    assert "URDF" in drawn_from
    assert {shell.carrier for shell in arm} == set(range(chain.n_joints + 1))
    # Radii that the cell states come first.
    stated = replace(cell, workspace=Workspace(link_radius=(0.05,)))
    assert "capsules" in shells_of(stated, chain)[-1]


@pytest.fixture(scope="module")
def cell():
    solids = tuple(Solid(f"a {name}", name, size, PLACED) for name, (size, _) in SOLIDS.items())
    workspace = Workspace(
        solids, keep_out=(HalfSpace("floor", np.zeros(3), np.array([0, 0, 1.0])),)
    )
    base = Nominal(base_position=np.array([0.3, 0.2, 0.1]), base_rotation=PLACED[:3, :3])
    tracker = Tracker(np.array([4.0, 1.0, 1.2]))
    return replace(kr270_cell(nominal=base), workspace=workspace, tracker=tracker)


def plan_at(cell, q, group, group_names, names=None):
    stops = [SimpleNamespace(pose=k, again=0) for k in range(len(q))]
    return SimpleNamespace(
        model=SimpleNamespace(cell=cell, chain=kr270_chain()), q=q, group=np.asarray(group),
        group_names=tuple(group_names), names=names or [str(i + 1) for i in range(len(q))],
        level_joint=1, execution=SimpleNamespace(stops=stops),
    )  # fmt: skip


def tips(axes):
    return [line for line in axes.lines if str(line.get_label()).startswith("q2")]


def test_flanges_are_drawn_where_the_model_puts_them_in_every_view(cell):
    level = [int(np.argmin(np.abs(np.subtract(LEVELS, v)))) for v in TABLE_2[:, 1]]
    names = [f"q2 = {np.degrees(v):.2f}°" for v in LEVELS]
    figure = figure_of(plan_arm(plan_at(cell, TABLE_2, level, names)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cell.model.nominal.base_rotation, cell.model.nominal.base_position
    expected = (T @ nominal_flanges(kr270_chain(), TABLE_2))[:, :3, 3]
    _, top, side = figure.axes
    for axes, pick in ((top, [0, 1]), (side, [0, 2])):
        drawn = np.concatenate([line.get_xydata() for line in tips(axes)])
        order = np.argsort(level, kind="stable")
        assert len(tips(axes)) == len(LEVELS) and np.allclose(drawn, expected[order][:, pick])
    told = {t.get_text() for t in top.texts}
    numbers = map(str, range(1, len(TABLE_2) + 1))
    assert told >= {*numbers, *(f"a {name}" for name in SOLIDS), "tracker"}
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
