"""How the parameters move the tool at the test poses, against derivatives of the arm itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.cells import COMPENSATOR, COMPLIANCE, DOWN, TABLE_2, kr270_chain, random_poses
from support.cells import table_of as rows_with_markers
from support.design_cells import FULL, any_cell, plan_cell, setup_of, sliding_chain, value_of

from elastocal.cell import Cell
from elastocal.cell_tables import Nominal, TargetPose
from elastocal.messages import InsufficientDataError
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Parameter
from elastocal.model.manipulator import Model
from elastocal.planning import poses as target_poses
from elastocal.planning.poses import TargetPoses, prediction_rows

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
POINT = np.array([0.1, -0.2, 0.4])
LEVELS = tuple(np.unique(TABLE_2[:, 1]).tolist())


def rows_at(cell: Cell, targets: TargetPoses, x: NDArray, chain: Chain = CHAIN) -> NDArray:
    return prediction_rows(Model.assembled(chain, cell), targets, x)


def somewhere(model: Model, seed: int = 0) -> NDArray:
    """The arm with every parameter off its nominal value by a plausible amount."""
    turns = np.random.default_rng(seed).uniform(-1, 1, len(model.names))
    return model.nominal + np.array([size(p) for p in model.parameters]) * turns


def size(p: Parameter) -> float:
    return 0.2 * abs(p.nominal) or (p.typical if "N" in p.unit else None) or 1e-3


def moved(model: Model, targets: TargetPoses, x: NDArray, by_marker: NDArray) -> NDArray:
    """Positions (T, M, 3) of what is to be predicted, times its share: point, or each marker."""
    places = model.cell.tool.markers
    table = rows_with_markers(targets.q, np.zeros(3), tuple(places))
    force = np.repeat(targets.force, len(places), axis=0)
    T = model.flange_poses(replace(table, force=force, rotation=np.zeros((len(table), 3))), x)
    T = T.reshape(len(targets.q), len(places), 4, 4)
    known = dict(zip(model.names, x, strict=True))
    markers = np.array(
        [
            [known.get(f"marker:{m}.{a}", v) for a, v in zip("xyz", places[m], strict=True)]
            for m in places
        ]
    )
    point = np.einsum("tij,tj->ti", T[:, 0, :3, :3], targets.point) + T[:, 0, :3, 3]
    each = np.einsum("tmij,mj->tmi", T[:, :, :3, :3], markers) + T[..., :3, 3]
    lone = np.concatenate([point[:, None], np.zeros_like(each)[:, 1:]], axis=1)
    return np.where(by_marker[:, None, None], each / np.sqrt(len(places)), lone)


def differences(model: Model, targets: TargetPoses, x: NDArray, by_marker: NDArray) -> NDArray:
    """∂moved/∂x (T, M, 3, parameters) by central differences."""
    columns = []
    for k, p in enumerate(model.parameters):
        step = np.zeros(len(x))
        step[k] = 0.01 * size(p)
        after, before = (moved(model, targets, x + s, by_marker) for s in (step, -step))
        columns.append((after - before) / (2 * step[k]))
    return np.stack(columns, axis=-1)


SAGGING = {
    "link_gravity": True,
    "nominal": Nominal(joint_compliance=COMPLIANCE, gravity_compensator=COMPENSATOR),
}
CASES: dict[str, tuple[Chain, Cell]] = {
    "one marker fitted": (CHAIN, plan_cell((*FULL[:-1], "marker_position:marker:M2"), "position")),
    "deflections": (CHAIN, plan_cell((FULL[3], "joint_offset:joint2"), loads=DOWN[None])),
    "levels": (
        CHAIN,
        plan_cell((*FULL[1:2], *FULL[3:], "off_axis_compliance"), "position", loads=BOTH,
                  model={"compliance_levels": {"joint2": LEVELS}}),
    ),
    "weights and compensator": (
        CHAIN, plan_cell((*FULL, "gravity_compensator"), "position", model=SAGGING, loads=BOTH)
    ),
    "full poses": (CHAIN, plan_cell((*FULL, "marker_orientation"), "pose", loads=BOTH)),
    "sliding joints": (sliding_chain(), any_cell(sliding_chain(), FULL, loads=BOTH / 10)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_rows_are_how_position_changes_with_the_parameters(case: str) -> None:
    """Points that are stated, and the markers where they are fitted and none is stated."""
    chain, cell = CASES[case]
    q = TABLE_2[[0, 4, 8, 13]] if chain is CHAIN else random_poses(chain, 4, 1)
    poses = [TargetPose(q[k], point=POINT if k % 2 else None, weight=1.0 + k) for k in range(4)]
    cell = replace(cell, design=replace(cell.design, test_poses=tuple(poses)))
    model = Model.assembled(chain, cell)
    targets = target_poses.test_poses(cell, chain)
    x = somewhere(model)
    A = rows_at(cell, targets, x, chain)
    fitted = any(p.effect == "marker_position" for p in model.parameters)
    by_marker = np.array([True, False, True, False]) & fitted
    expected = differences(model, targets, x, by_marker)
    if cell.model.observe == "deflection":
        expected -= differences(model, replace(targets, force=0 * targets.force), x, by_marker)
    expected = expected[:, : 3 if fitted else 1].reshape(4, -1, len(x))
    scale = np.abs(expected).max(axis=(0, 1))
    assert np.abs(A - expected).max(axis=(0, 1)) == pytest.approx(0 * scale, abs=2e-6 * scale.max())
    observed = scale > 0
    assert (np.abs(A - expected).max(axis=(0, 1))[observed] < 1e-5 * scale[observed] + 1e-11).all()


def test_a_point_on_the_tool_goes_with_fitted_markers_where_nothing_else_tells() -> None:
    """Against the least-squares motion of the markers, by differences of where they are."""
    q = TABLE_2[[0, 8]]
    poses = tuple(TargetPose(one, point=POINT) for one in q)
    cell = plan_cell(FULL, "position", loads=BOTH, test_poses=poses)
    setup = setup_of(cell, random_poses(CHAIN, 120, seed=1))
    (told,) = [text for text in setup.warnings if "point_m" in text]
    assert "fixed to the markers" in told and np.isfinite(value_of(setup, TABLE_2))
    model, targets = Model.assembled(CHAIN, cell), target_poses.test_poses(cell, CHAIN)
    x, names = model.nominal, tuple(cell.tool.markers)
    A = prediction_rows(model, targets, x, carried=True)
    table = replace(rows_with_markers(targets.q, np.zeros(3), names),
                    force=np.repeat(targets.force, len(names), axis=0))  # fmt: skip
    places = np.array(list(cell.tool.markers.values()))

    def at(x: NDArray) -> NDArray:
        """Where the point is (T, 3), by Kabsch's rotation of the markers' places."""
        found = []
        for seen in model.predict(table, x).reshape(len(q), len(names), 3):
            middle, own = seen.mean(axis=0), places.mean(axis=0)
            turn = Rotation.align_vectors(seen - middle, places - own)[0]
            found.append(middle + turn.apply(POINT - own))
        return np.array(found)

    step = 1e-4 * np.random.default_rng(0).normal(size=len(x)) * [size(p) for p in model.parameters]
    expected = (at(x + step) - at(x - step)) / 2
    assert A @ step == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    two = replace(cell, tool=replace(cell.tool, markers=dict(list(cell.tool.markers.items())[:2])))
    with pytest.raises(InsufficientDataError, match=r"leave out point_m, .* or measure a third"):
        setup_of(two, random_poses(CHAIN, 120, seed=1))


def test_a_tracker_that_distorts_leaves_a_plan_for_what_it_reads() -> None:
    """Its scale cannot be told from the arm's lengths: the tool's place is open, readings not."""
    cell = plan_cell((*FULL, "tracker_distortion"), "position", loads=BOTH)
    assert np.isfinite(value_of(setup_of(cell, random_poses(CHAIN, 40, seed=1)), TABLE_2))
