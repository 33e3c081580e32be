"""A command puts the tool at its target, says so where it cannot, and keeps the limits; along a
path neighbours have neighbouring joints; a correction table does the same on a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import COMPENSATOR, COMPLIANCE, DOWN, SLANTED, kr270_cell, kr270_chain, table_of

import elastocal as ec
from elastocal.cell import Cell
from elastocal.cell_tables import Nominal
from elastocal.compensation import Compensation, compensate, nominal_path, read_targets, targets_at
from elastocal.correction_table import EXACT, CorrectionGrid, correction_table
from elastocal.messages import InputError
from elastocal.model.calibrated import CalibratedArm, ShownPoses, tool_point
from elastocal.model.chain import Chain, joint_limits
from elastocal.model.manipulator import Model
from elastocal.model.rigid import nominal_flanges
from elastocal.units import Array

EVERYWHERE = ("base_frame", "joint_offset", "link_geometry", "marker_position", "joint_compliance")
# Regular postures of the KR 270, well inside its limits.
POSTURES = np.radians(
    [
        [10, -80, 90, 30, 50, -20],
        [-60, -60, 60, -80, 60, 100],
        [80, -110, 100, 120, -70, -150],
        [-120, -90, 20, -40, -50, 60],
    ]
)
FARTHEST = 1e-7  # m and rad


def calibrated(chain: Chain, cell: Cell, std: float = 0.0) -> CalibratedArm:
    """The nominal arm, every parameter determined with `std` times its typical size."""
    model = Model.assembled(chain, cell)
    sizes = np.array([p.typical or abs(p.nominal) or 1.0 for p in model.parameters])
    covariance = np.diag((std * sizes) ** 2)
    return CalibratedArm(model, model.nominal, model.names, covariance, "result.json")


def erring(model: Model, rng: np.random.Generator, scale: float = 1.0) -> Array:
    """Every parameter off its nominal value by `scale` of its typical size."""
    sizes = np.array([p.typical or 0.2 * abs(p.nominal) for p in model.parameters])
    return model.nominal + scale * sizes * rng.choice([-1.0, 1.0], len(sizes))


def tool_errors(arm: CalibratedArm, found: Compensation, marker: str = "M1") -> tuple[Array, Array]:
    """Distance in m and angle in rad (n,) of the marker from the targets, by the model that
    identification predicts with, not by the expressions that commands are sought with."""
    table, names = found.targets.table, tuple(arm.model.cell.tool.markers)
    rows = replace(
        table_of(found.q, np.zeros(3), names).take(np.arange(len(found.q)) * len(names)),
        marker=np.full(len(found.q), names.index(marker)), force=found.force,
        rotation=np.zeros((len(found.q), 3)), time=table.time, approach=table.approach,
        temperature=table.temperature,
    )  # fmt: skip
    rotation, position = arm.model.target_poses(rows, arm.x)
    miss = np.linalg.norm(position - found.goals[:, :3, 3], axis=1)
    if not found.oriented:
        return miss, np.zeros_like(miss)
    turned = Rotation.from_matrix(found.goals[:, :3, :3].transpose(0, 2, 1) @ rotation)
    return miss, turned.magnitude()


def arm_of(*effects, rng=None, scale=1.0, std=0.0, **how):
    """The KR 270 with effects, off its nominal values where numbers are drawn from `rng`."""
    arm = calibrated(kr270_chain(), kr270_cell(effects, **how), std=std)
    return arm if rng is None else replace(arm, x=erring(arm.model, rng, scale))


def commanded(arm, targets, point="M1", near=None):
    return compensate(arm, targets, tool_point(arm.model.cell, point), near=near)


def at_postures(load=DOWN, n=4):
    """The places of the nominal arm's tool in the first n postures."""
    return targets_at("targets.csv", None, None, "base", load, q=POSTURES[:n])


@pytest.mark.parametrize(
    "effects",
    [
        ("encoder_scale", "gear_eccentricity", "gear_second_harmonic", "gear_ripple"),
        ("wrist_coupling", "backlash", "hysteresis", "joint_hardening", "joint_curve:joint2"),
        ("off_axis_compliance:joint2", "link_bending:link2", "base_compliance"),
        ("gravity_compensator", "payload_error", "link_mass_error"),
        ("thermal_expansion:all", "base_drift", "joint_drift:joint2", "marker_slip:marker:M1"),
        ("encoder_jump:joint3", "link_jump:link2", "tool_jump", "frame_jump", "marker_orientation"),
    ],
)
def test_every_effect_is_undone(effects):
    names = {e.partition(":")[0] for e in effects}
    asked = {"joint_curve": ("joint2", {"curve_low_rad": -2.4, "curve_high_rad": 0.0}),
             "encoder_jump": ("joint3", {"jump_time_s": 3000.0}),
             "frame_jump": ("tracker", {"jump_time_s": 4000.0}),
             "link_jump": ("link2", {"jump_time_s": 4000.0}),
             "tool_jump": ("tool", {"jump_time_s": 4000.0}),
             "marker_slip": ("marker:M1", {"slip_time_s": 2000.0})}  # fmt: skip
    nominal = Nominal(
        joint_compliance=COMPLIANCE,
        gravity_compensator=COMPENSATOR if "gravity_compensator" in names else None,
        settings=dict(found for name, found in asked.items() if name in names),
    )
    rng, n = np.random.default_rng(5), len(POSTURES)
    how = {"nominal": nominal, "link_gravity": True, "gear_ripple_orders": (88.5,)}
    arm = arm_of(*EVERYWHERE, *effects, rng=rng, **how)
    # Targets a few mm and mrad from where the nominal flange is.
    T = nominal_flanges(arm.model.chain, POSTURES)
    turn = Rotation.from_rotvec(2e-3 * rng.normal(size=(n, 3))).as_matrix()
    position = T[:, :3, 3] + 2e-3 * rng.normal(size=(n, 3))
    targets = targets_at("targets", position, T[:, :3, :3] @ turn, "base", SLANTED, q=POSTURES)
    targets = replace(targets, table=replace(
        targets.table, time=np.sort(rng.uniform(0.0, 7200.0, n)),
        approach=rng.choice([-1.0, 1.0], (n, 6)), temperature=rng.uniform(18.0, 26.0, n),
    ))  # fmt: skip
    found = commanded(arm, targets)
    assert found.status == ("reached",) * n
    miss, turned = tool_errors(arm, found)
    assert miss.max() < FARTHEST and turned.max() < FARTHEST
    # The nominal command itself was far off: the test would see an effect left out.
    assert found.before.min() > 1e-4


def test_a_limit_is_kept_and_named():
    chain, high = kr270_chain(), POSTURES[0, 2]
    cell = replace(kr270_cell(EVERYWHERE), limits={"joint3": (high - 0.5, high)})
    arm = calibrated(chain, cell)
    arm = replace(arm, x=erring(arm.model, np.random.default_rng(1)))
    # A posture further out, which needs joint 3 beyond its limit.
    wanted = nominal_flanges(chain, POSTURES[:1] + np.array([0, 0, 0.05, 0, 0, 0]))
    targets = targets_at("t", wanted[:, :3, 3], wanted[:, :3, :3], "base", DOWN, q=POSTURES[:1])
    found = commanded(arm, targets, "0,0,0.001")
    assert found.status == ("limit",) and found.after[0] > 1e-3 and found.q[0, 2] <= high
    assert np.isnan(found.uncertainty.std[0])
    # With the rotation free, the other joints take over, and a sentence says so.
    free = commanded(arm, replace(targets, rotation=None), "0,0,0.001")
    assert free.status == ("reached",) and free.q[0, 2] <= high
    assert any("joint 3 stands at its limit" in told for told in free.warnings)


def test_uncertainty_is_what_other_values_would_do():
    """Σ_p by differences of the model's own predictions, not by the derivative under test."""
    arm = arm_of(*EVERYWHERE, rng=np.random.default_rng(4), std=0.01)
    found = commanded(arm, at_postures())
    std = np.sqrt(np.diag(arm.covariance))
    rows = arm.model.table(found.q)
    rows = replace(rows, force=found.force, marker=0 * rows.configuration)
    off, turned = [], []
    for step in np.diag(std):
        one, other = (arm.model.target_poses(rows, arm.x + way * step) for way in (1, -1))
        off.append((one[1] - other[1]) / 2)
        turned.append(Rotation.from_matrix(one[0] @ other[0].transpose(0, 2, 1)).as_rotvec() / 2)
    for sure, moves in ((found.uncertainty, off), (found.turn_uncertainty, turned)):
        expected = np.sqrt((np.array(moves) ** 2).sum(axis=(0, 2)))
        assert np.allclose(sure.std, expected, rtol=1e-3) and not sure.blamed


def test_targets_far_from_what_was_measured_are_told_and_a_point_known_worse_is_the_reason():
    arm = arm_of("joint_offset", std=0.01)

    def told(most, configurations=30, point="M1"):
        shown = replace(arm, shown=ShownPoses(most, configurations))
        return " ".join(commanded(shown, at_postures(), point).warnings)

    std = commanded(arm, at_postures()).uncertainty.std
    far = "outside the measured poses"
    assert far not in told(std.max())
    assert "line 1 and 3 more" in told(std.min() / 2) and far in told(std.min() / 2)
    # Of as few poses measured all may be surer than four others by chance.
    assert far not in told(std.min() / 2, configurations=2)
    # Where the markers are known as well as at measured poses, it is not the poses.
    assert far not in (text := told(std.max(), point="6,0,0"))
    assert "where the point 6,0,0 m in the flange frame lies on the tool is hardly known" in text
    assert float(told(std.min() / 2, point="6,0,0").split(far)[1].split()[2]) < 1.1e6 * std.max()


def test_what_no_marker_showed_is_told():
    """Tool and last link move the markers alike, so that a marker is known and the flange not."""
    model = arm_of("base_frame", "link_geometry:link6", "marker_position").model
    q = np.random.default_rng(0).uniform(POSTURES.min(axis=0), POSTURES.max(axis=0), (30, 6))
    arm = ec.identify(model, ec.simulate(model, q, seed=1)).arm
    assert np.all(commanded(arm, at_postures(None)).uncertainty.unknown < 1e-9)
    place = commanded(arm, at_postures(None), "0.1,0.2,0.3")
    assert np.all(place.uncertainty.unknown > 1e-3)
    assert any("link6." in told and "`point`" in told for told in place.warnings)
    assert any("link6." in told and "rotation" in told for told in place.warnings)


# Paths

HOME = np.radians([0, -90, 90, 0, 40, 0])
PLACE = np.array([0.1, 0.0, 0.2])


def circle(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A circle of 0.3 m about where the tool is at home, with the tool's rotation kept."""
    T = nominal_flanges(kr270_chain(), HOME[None])[0]
    angle = np.linspace(0, 2 * np.pi, n)
    ring = 0.3 * np.column_stack([0 * angle, np.cos(angle), np.sin(angle)])
    return T[:3, 3] + T[:3, :3] @ PLACE + ring, np.tile(T[:3, :3], (n, 1, 1))


def test_a_closed_path_is_followed_in_one_posture() -> None:
    targets = targets_at("path", *circle(2000), "base", DOWN)
    arm = replace(arm_of("joint_compliance"), loads=DOWN[None] / 2)
    found = commanded(arm, targets, "0.1,0,0.2", HOME)
    assert found.reached.all() and np.abs(found.q[-1] - found.q[0]).max() < 1e-9
    assert np.abs(np.diff(found.q, axis=0)).max() < 0.01
    assert ["of 2600 N, where 1300 N at most" in told for told in found.warnings] == [True]


def test_given_joints_that_jump_are_told() -> None:
    arm, targets = arm_of("joint_compliance"), targets_at("path", *circle(40), "base", DOWN)
    q = commanded(arm, targets, "0.1,0,0.2", HOME).nominal.copy()
    # The other posture of the wrist: q4 + 180°, −q5, q6 + 180° is the same pose.
    q[20:] = q[20:] * [1, 1, 1, 1, -1, 1] + np.array([0, 0, 0, np.pi, 0, -np.pi])
    found = commanded(arm, replace(targets, q=q), "0.1,0,0.2")
    assert not commanded(arm, replace(targets, q=q, position=None), "0.1,0,0.2").warnings
    told = [text for text in found.warnings if "solution branch changes" in text]
    assert len(told) == 1 and told[0].startswith("path, line 21:") and "one posture" in told[0]


def test_scattered_places_are_reached_in_the_nearest_posture_and_one_out_of_reach_stops_none():
    chain = kr270_chain()
    limits = joint_limits(kr270_cell(), chain)
    q = HOME + np.radians([[0, 0, 0, 0, 0, 0], [50, 20, -30, 10, 20, 60], [-60, -10, 20, 5, 10, 0]])
    T = nominal_flanges(chain, q)
    position = T[:, :3, 3] + T[:, :3, :3] @ PLACE
    found, reached = nominal_path(chain, position, T[:, :3, :3], PLACE, limits, HOME)
    assert reached.all() and np.allclose(found, q, atol=1e-5)
    position, rotation = circle(30)
    position[10] = [9.0, 0.0, 0.0]
    q, reached = nominal_path(chain, position, rotation, PLACE, limits, HOME)
    assert np.flatnonzero(~reached).tolist() == [10] and np.abs(q[11] - q[9]).max() < 0.2


# Correction tables

LOW = np.radians([-30, -110, 60, -20, 40, -20])
HIGH = np.radians([30, -70, 100, 20, 80, 20])


def arm_and_point():
    effects = ("joint_offset", "link_geometry", "joint_compliance")
    arm = arm_of(*effects, rng=np.random.default_rng(8), scale=0.5)
    return arm, tool_point(arm.model.cell, "M1")


def joint_box(counts) -> list[np.ndarray]:
    ends = zip(LOW, HIGH, counts, strict=True)
    return [np.linspace(a, b, n) if n > 1 else np.array([(a + b) / 2]) for a, b, n in ends]


def test_corrected_targets_are_reached_by_the_nominal_arm() -> None:
    arm, point = arm_and_point()
    grid = CorrectionGrid(tuple(joint_box((2, 2, 1, 1, 2, 1))), True)
    found = correction_table(arm, grid, point, DOWN)
    assert set(found.status) == {EXACT}
    T = nominal_flanges(arm.model.chain, found.points)
    place = T[:, :3, 3] + T[:, :3, :3] @ arm.model.cell.tool.markers["M1"]
    turned = Rotation.from_rotvec(found.correction[:, 3:]).as_matrix() @ T[:, :3, :3]
    # A rigid, nominal arm stands for the controller.
    rigid = kr270_cell(())
    controller = compensate(
        calibrated(arm.model.chain, rigid),
        targets_at("t", place + found.correction[:, :3], turned, "base", q=found.points),
        tool_point(rigid, "M1"),
    )
    assert controller.reached.all()
    real = compensate(arm, targets_at("t", None, None, "base", DOWN, q=found.points), point)
    miss, turn = tool_errors(arm, replace(real, q=controller.q))
    assert miss.max() < 1e-7 and turn.max() < 1e-7


def test_a_grid_in_singular_postures_is_told_with_the_joint_at_fault() -> None:
    arm, point = arm_and_point()
    axes = joint_box((2, 1, 1, 1, 1, 1))
    assert correction_table(arm, CorrectionGrid(tuple(axes), True), point, DOWN).warnings == ()
    axes[4] = np.zeros(1)
    (told,) = correction_table(arm, CorrectionGrid(tuple(axes), True), point, DOWN).warnings
    assert told.startswith("only 0 of 2 grid points are exact")
    assert "singular by the levels of q5_deg = 0;" in told and "q4" not in told and "q6" not in told


# Targets as texts and tables


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("rx_deg,ry_deg,rz_deg\n1,2,3\n", "x_mm,y_mm,z_mm are missing"),
        ("x_mm,y_mm,z_mm,q1_deg\n1,2,3,4\n", "positions of the 6 joints"),
        ("x_mm,y_mm,z_mm,marker\n1,2,3,A\n1,2,3,B\n", "`point`"),
    ],
)
def test_tables_that_say_no_target_are_refused(tmp_path, text, told) -> None:
    path = tmp_path / "targets.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=told):
        read_targets(path, ("revolute",) * 6, "base")
