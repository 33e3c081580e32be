"""The posed arm of the 3-D views: where it stands, how long its arrows are, what a page holds."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cells import TABLE_2, kr270_cell, kr270_chain, nominal_flanges
from support.robots import packaged_urdf

from elastocal.cell.arm_description import Robot
from elastocal.cell.work_cell import Solid, Workspace
from elastocal.model.manipulator import load_chain
from elastocal.report.arm_view import (
    frames_at,
    in_script,
    residual_arm,
    shells_of,
    triangles_of,
)

TURNED = np.eye(4)
TURNED[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
TURNED[:3, 3] = 1.0, -2.0, 0.5
BALL = 4 / 3 * np.pi
SOLIDS = {
    "box": (np.array([0.5, 0.8, 1.2]), 0.48),
    "sphere": (np.array([0.4]), BALL * 0.4**3),
    "cylinder": (np.array([0.2, 3.0]), np.pi * 0.2**2 * 3.0),
    "capsule": (np.array([0.15, 1.0]), np.pi * 0.15**2 * 1.0 + BALL * 0.15**3),
}


@pytest.mark.parametrize("shape", SOLIDS)
def test_triangles_close_the_solid_from_outside(shape: Any) -> None:
    size, volume = SOLIDS[shape]
    points, faces = triangles_of(Solid(shape, shape, size, TURNED))
    a, b, c = (points[faces[:, k]] - TURNED[:3, 3] for k in range(3))
    # Divergence theorem: positive only where all triangles turn outwards.
    enclosed = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
    assert 0.85 * volume <= enclosed <= 1.0001 * volume
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert there == {(j, i) for i, j in there}
    assert len(there) == len(edges)


def test_arm_stands_where_the_kinematics_puts_it() -> None:
    cell, chain = kr270_cell(), kr270_chain()
    frames, flange = frames_at(cell, chain, TABLE_2)
    assert flange == pytest.approx(nominal_flanges(chain, TABLE_2))
    assert frames.shape == (len(TABLE_2), chain.n_joints + 1, 4, 4)
    moved = TURNED @ flange
    frames_moved, end = frames_at(cell, chain, TABLE_2, moved)
    assert end == pytest.approx(moved)
    assert frames_moved == pytest.approx(TURNED @ frames)
    # A pose without equilibrium stands at its nominal place.
    moved[3] = np.nan
    assert frames_at(cell, chain, TABLE_2, moved)[1][3] == pytest.approx(flange[3])


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
    for name, marker, arrow in zip(pose.names, pose.markers, pose.arrows, strict=True):
        own = (observed.configuration == code) & (loaded == (load != "unloaded"))
        own &= table.marker[observed.lead] == table.marker_names.index(name)
        assert arrow == pytest.approx(parts[own].mean(axis=0))
        assert marker == pytest.approx(table.position[observed.lead][own].mean(axis=0))
    # The arm ends where the model puts the flange.
    row = observed.lead[(observed.configuration == code) & (loaded == (load != "unloaded"))][:1]
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
    shells = shells_of(cell, chain)
    assert "URDF" in shells.drawn_from
    assert {shell.carrier for shell in shells.arm} == set(range(chain.n_joints + 1))
    # Radii that the cell states come first.
    stated = replace(cell, workspace=Workspace(link_radius=(0.05,)))
    assert "capsules" in shells_of(stated, chain).drawn_from
