"""The picture of poses: what is drawn is where the arm stands."""

import re
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import TABLE_2, kr270_cell, kr270_chain, nominal_flanges, random_poses

from elastocal.cell.arm_description import Nominal, Tracker
from elastocal.cell.workspace_rules import HalfSpace, Solid, Workspace
from elastocal.errors import InputError
from elastocal.report.plan_picture import draw_plan, wireframe, write_plan_picture

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


def options(q):
    level = np.array([int(np.argmin(np.abs(np.subtract(LEVELS, v)))) for v in q[:, 1]])
    return {
        "names": [str(i + 1) for i in range(len(q))],
        "group": level,
        "group_names": [f"q2 = {np.degrees(v):.2f}°" for v in LEVELS],
    }


def distance(solid, points):
    """Signed distance of points (k, 3) from the solid's surface, by its definition."""
    p = (points - solid.placement[:3, 3]) @ solid.placement[:3, :3]
    if solid.shape == "box":
        return np.abs(np.abs(p) - solid.size / 2).min(axis=1) + np.maximum(
            np.abs(p) - solid.size / 2, 0
        ).max(axis=1)
    if solid.shape == "sphere":
        return np.linalg.norm(p, axis=1) - solid.size[0]
    along = np.clip(p[:, 2], -solid.size[1] / 2, solid.size[1] / 2)
    if solid.shape == "capsule":
        return np.linalg.norm(p - np.outer(along, [0, 0, 1]), axis=1) - solid.size[0]
    return np.linalg.norm(p[:, :2], axis=1) - solid.size[0] + np.abs(p[:, 2] - along)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: s.shape)
def test_every_line_of_a_wireframe_lies_on_the_surface_and_spans_it(solid):
    lines = np.concatenate(wireframe(solid))
    assert np.allclose(distance(solid, lines), 0, atol=1e-12)
    local = (lines - solid.placement[:3, 3]) @ solid.placement[:3, :3]
    full = {"box": solid.size / 2, "sphere": np.repeat(solid.size, 3)}.get(solid.shape)
    if full is None:
        cap = solid.size[0] if solid.shape == "capsule" else 0.0
        full = np.array([solid.size[0], solid.size[0], solid.size[1] / 2 + cap])
    assert np.allclose(local.max(axis=0), full) and np.allclose(local.min(axis=0), -full)


def test_a_box_has_its_twelve_edges():
    edges = wireframe(SOLIDS[0])
    lengths = [float(np.linalg.norm(a - b)) for a, b in edges]
    assert np.allclose(sorted(lengths), sorted([0.5, 0.8, 1.2] * 4))


def test_flanges_are_drawn_where_the_model_puts_them_in_every_view(cell):
    chain = kr270_chain()
    figure = draw_plan(cell, chain, TABLE_2, **options(TABLE_2))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cell.model.nominal.base_rotation, cell.model.nominal.base_position
    expected = (T @ nominal_flanges(chain, TABLE_2))[:, :3, 3]
    space, top, side = figure.axes
    for axes, pick in ((top, [0, 1]), (side, [0, 2])):
        tips = [line for line in axes.lines if re.match("q2", str(line.get_label()))]
        drawn = np.concatenate([line.get_xydata() for line in tips])
        assert len(tips) == 5 and np.allclose(drawn, expected[:, pick])
    tips = [line for line in space.lines if re.match("q2", str(line.get_label()))]
    drawn = np.concatenate([np.array(line.get_data_3d()).T for line in tips])
    assert np.allclose(drawn, expected)
    assert {t.get_text() for t in top.texts} >= set(NAMES)


def test_groups_differ_in_colour_and_sign_even_when_there_are_many(cell):
    q = random_poses(kr270_chain(), 20, 0)
    figure = draw_plan(cell, kr270_chain(), q, names=[""] * 20, group=np.arange(20),
                       group_names=[f"g{k}" for k in range(20)])  # fmt: skip
    marks = {
        (line.get_color(), line.get_marker())
        for line in figure.axes[1].lines
        if str(line.get_label()).startswith("g")
    }
    assert len(marks) == 20


def test_names_from_files_are_not_formulas_and_sixty_poses_are_drawn(cell, tmp_path):
    q = random_poses(kr270_chain(), 60, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_plan_picture(tmp_path / "plan.svg", cell, kr270_chain(), q,
                           names=[f"${i}_<&\"" for i in range(60)], group=np.zeros(60, int),
                           group_names=["no load $x^$"])  # fmt: skip
    ET.parse(tmp_path / "plan.svg")


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_plan_gives_the_same_file(cell, tmp_path, suffix):
    files = [tmp_path / f"{k}{suffix}" for k in range(2)]
    for file in files:
        write_plan_picture(file, cell, kr270_chain(), TABLE_2, **options(TABLE_2))
    content = [file.read_bytes() for file in files]
    assert content[0] == content[1]
    assert content[0].startswith({".png": b"\x89PNG", ".svg": b"<?xml"}[suffix])


def test_other_formats_are_refused(cell, tmp_path):
    with pytest.raises(InputError, match=r"\.png or \.svg"):
        write_plan_picture(tmp_path / "plan.pdf", cell, kr270_chain(), TABLE_2, **options(TABLE_2))
    assert not list(tmp_path.iterdir())
