"""A command puts the tool at its target, says so where it cannot, and keeps the limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.calibration import cell_of, random_chain
from support.cells import (
    COMPENSATOR,
    COMPLIANCE,
    DOWN,
    SLANTED,
    kr270_cell,
    kr270_chain,
    random_poses,
)
from support.commands import calibrated, circumstances, erring, tool_errors

from elastocal.cell.arm_description import Nominal
from elastocal.compensation.commands import targets_at
from elastocal.compensation.compensate import compensate
from elastocal.errors import InputError
from elastocal.model.calibrated import (
    Conditions,
    OpenParameters,
    ShownPoses,
    random_table,
    tool_point,
)
from elastocal.model.manipulator import Model
from elastocal.model.rigid import nominal_flanges

EVERYWHERE = ("base_frame", "joint_offset", "link_geometry", "marker_position", "joint_compliance")
SOME = ("joint_offset", "link_geometry:link3", "joint_compliance")
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


def near(chain, q, rng, size=2e-3):
    """Targets a few mm and mrad from where the nominal flange is at q: (n, 3), (n, 3, 3)."""
    T = nominal_flanges(chain, q)
    turn = Rotation.from_rotvec(size * rng.normal(size=(len(q), 3))).as_matrix()
    return T[:, :3, 3] + size * rng.normal(size=(len(q), 3)), T[:, :3, :3] @ turn


@pytest.mark.parametrize(
    "effects",
    [
        ("encoder_scale", "gear_eccentricity", "gear_second_harmonic", "gear_ripple"),
        ("wrist_coupling", "backlash", "hysteresis", "joint_hardening"),
        ("off_axis_compliance:joint2", "link_bending:link2", "base_compliance"),
        ("gravity_compensator", "payload_error", "link_mass_error"),
        ("thermal_expansion:all", "base_drift", "joint_drift:joint2", "marker_slip:marker:M1"),
        ("encoder_jump:joint3", "frame_jump", "marker_orientation"),
    ],
)
def test_every_effect_is_undone(effects):
    check_effects(effects, "equilibrium", FARTHEST)


def check_effects(effects, model, farthest_turn):
    settings_of = {
        "joint3": {"jump_time_s": 3000.0},
        "tracker": {"jump_time_s": 4000.0},
        "marker:M1": {"slip_time_s": 2000.0},
    }
    names = {e.partition(":")[0] for e in effects}
    keep = {
        "joint3": "encoder_jump" in names,
        "tracker": "frame_jump" in names,
        "marker:M1": "marker_slip" in names,
    }
    nominal = Nominal(
        joint_compliance=COMPLIANCE,
        gravity_compensator=COMPENSATOR if "gravity_compensator" in names else None,
        settings={place: given for place, given in settings_of.items() if keep[place]},
    )
    cell = kr270_cell(
        (*EVERYWHERE, *effects), nominal=nominal, deflection_model=model, link_gravity=True,
        gear_ripple_orders=(88.5,),
    )  # fmt: skip
    chain, rng = kr270_chain(), np.random.default_rng(5)
    arm = calibrated(chain, cell)
    arm = replace(arm, x=erring(arm.model, rng))
    position, rotation = near(chain, POSTURES, rng)
    targets = targets_at("targets", position, rotation, "base", SLANTED, q=POSTURES)
    n = len(POSTURES)
    targets = replace(targets, table=replace(targets.table, **circumstances(n, 6, rng)))
    # The flange's own place, so that nominal joints are near; M1 is some way off.
    found = compensate(arm, targets, tool_point(cell, "M1"))
    missed = [s for s in found.status if s != "reached"]
    assert not missed, missed
    miss, turn = tool_errors(arm, found)
    assert miss.max() < FARTHEST and turn.max() < farthest_turn
    # The nominal command itself was far off: the test would see an effect left out.
    assert found.before.min() > 1e-4


@settings(max_examples=3, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    joints=st.integers(6, 7),
    oriented=st.booleans(),
    load=st.floats(0.0, 300.0),
)
def test_random_arms_reach_what_they_can(seed, joints, oriented, load):
    """Targets of the nominal arm: reached within the limits, or said not to be."""
    check_random_arm(seed, joints, oriented, load)


def check_random_arm(seed, joints, oriented, load):
    rng = np.random.default_rng(seed)
    chain = random_chain(seed, joints)
    nominal = Nominal(joint_compliance=(1e-5,) * joints)
    cell = cell_of(SOME, nominal=nominal)
    arm = calibrated(chain, cell)
    arm = replace(arm, x=erring(arm.model, rng, 0.3))
    q = rng.uniform(-1.8, 1.8, (4, joints))
    T = nominal_flanges(chain, q)
    goal = targets_at("t", T[:, :3, 3], T[:, :3, :3] if oriented else None, "base",
                      load * np.array([0.3, 0.2, -1.0]))  # fmt: skip
    found = compensate(arm, goal, tool_point(cell, "M1"), near=q[0])
    good = found.reached
    miss, turn = tool_errors(arm, found)
    assert np.all(miss[good] < FARTHEST) and np.all(turn[good] < FARTHEST)
    # A row that is not reached is never told to be, and never said to be near.
    assert np.all(miss[~good] > 1e-9) or np.all(turn[~good] > 1e-9)
    assert np.all(np.abs(found.q) <= 2.5)
    assert np.allclose(np.nan_to_num(found.after), np.nan_to_num(miss), atol=1e-12)


def narrow(limit: dict[str, tuple[float, float]]):
    return replace(kr270_cell(EVERYWHERE), limits=limit)


def test_a_limit_is_kept_and_named():
    chain, rng = kr270_chain(), np.random.default_rng(1)
    low, high = POSTURES[0, 2], POSTURES[0, 2]
    cell = narrow({"joint3": (low - 0.5, high)})
    arm = calibrated(chain, cell)
    arm = replace(arm, x=erring(arm.model, rng))
    # A posture further out, which needs joint 3 beyond its limit.
    wanted = nominal_flanges(chain, POSTURES[:1] + np.array([0, 0, 0.05, 0, 0, 0]))
    point = tool_point(cell, "0,0,0.001")
    targets = targets_at("t", wanted[:, :3, 3], wanted[:, :3, :3], "base", DOWN, q=POSTURES[:1])
    found = compensate(arm, targets, point)
    assert found.status == ("limit",)
    assert found.after[0] > 1e-3
    assert found.q[0, 2] <= high
    assert np.isnan(found.uncertainty.std[0])
    # With the rotation free, the other joints take over, and a sentence says so.
    free = compensate(arm, replace(targets, rotation=None), point)
    assert free.status == ("reached",)
    assert free.q[0, 2] <= high
    assert any("joint 3 stands at its limit" in told for told in free.warnings)


def test_a_column_that_the_model_needs_is_asked_for():
    cell = kr270_cell(("joint_offset", "hysteresis"))
    arm = calibrated(kr270_chain(), cell)
    targets = targets_at("targets.csv", None, None, "base", DOWN, q=POSTURES)
    with pytest.raises(InputError, match=r"targets\.csv: the model needs the column approach_1"):
        compensate(arm, targets, tool_point(cell, "M1"))


def test_uncertainty_is_what_other_values_would_do():
    """Σ_p by differences of the model's own predictions, not by the derivative under test."""
    chain, rng = kr270_chain(), np.random.default_rng(4)
    cell = kr270_cell(EVERYWHERE)
    arm = calibrated(chain, cell, std=0.01)
    arm = replace(arm, x=erring(arm.model, rng))
    targets = targets_at("t", None, None, "base", DOWN, q=POSTURES)
    found = compensate(arm, targets, tool_point(cell, "M1"))
    std = np.sqrt(np.diag(arm.covariance))
    off = []
    for k, s in enumerate(std):
        ends = []
        for sign in (1, -1):
            x = arm.x.copy()
            x[k] += sign * s
            ends.append(_places(arm.model, found, x))
        off.append((ends[0] - ends[1]) / 2)
    expected = np.sqrt((np.array(off) ** 2).sum(axis=(0, 2)))
    assert np.allclose(found.uncertainty.std, expected, rtol=1e-3)
    assert not found.uncertainty.blamed


def test_targets_far_from_what_was_measured_are_told():
    cell = kr270_cell(("joint_offset",))
    arm = calibrated(kr270_chain(), cell, std=0.01)
    targets = targets_at("t", None, None, "base", DOWN, q=POSTURES)

    def told(most, configurations=30):
        shown = replace(arm, shown=ShownPoses(most, configurations))
        warned = compensate(shown, targets, tool_point(cell, "M1")).warnings
        return [text for text in warned if "outside the measured" in text]

    std = compensate(arm, targets, tool_point(cell, "M1")).uncertainty.std
    assert not told(std.max())
    assert "line 1 and 3 more" in told(std.min() / 2)[0]
    # Of as few poses measured all may be surer than four others by chance.
    assert not told(std.min() / 2, configurations=2)


def test_a_point_that_is_known_worse_than_the_markers_is_the_reason():
    """Where the markers are known as well as at measured poses, it is not the poses."""
    cell = kr270_cell(("joint_offset",))
    arm = calibrated(kr270_chain(), cell, std=0.01)
    targets = targets_at("t", None, None, "base", DOWN, q=POSTURES)
    most = compensate(arm, targets, tool_point(cell, "M1")).uncertainty.std.max()
    shown = replace(arm, shown=ShownPoses(most, 30))
    text = " ".join(compensate(shown, targets, tool_point(cell, "6,0,0")).warnings)
    assert "where the point 6,0,0 m in the flange frame lies on the tool is hardly known" in text
    assert "outside the measured poses" not in text


def _places(model: Model, found, x):
    from elastocal.measurements import Measurements

    n = len(found.q)
    rows = Measurements(
        source="t", row=np.arange(n), q=found.q, configuration=np.arange(n),
        configuration_labels=tuple(map(str, range(n))), repeat=np.zeros(n, dtype=np.int64),
        marker=np.zeros(n, dtype=np.int64), marker_names=tuple(model.cell.tool.markers),
        force=found.force,
    )  # fmt: skip
    return model.target_poses(rows, x)[1]


def test_what_no_marker_showed_is_told():
    """Tool and last link move the markers alike, so that a marker is known and the flange not."""
    chain = kr270_chain()
    cell = kr270_cell(("base_frame", "link_geometry:link6", "marker_position"))
    arm = calibrated(chain, cell, std=0.01)
    kept = tuple(name for name in arm.model.names if not name.startswith("link6"))
    n = len(kept)
    # What link 6 does to the markers went into the estimates of their places.
    markers, drawn = tuple(cell.tool.markers), random_table(arm.model, Conditions(), 60, 0)
    rows = replace(
        drawn.take(np.repeat(np.arange(60), len(markers))), marker_names=markers,
        marker=np.tile(np.arange(len(markers)), 60), position=np.zeros((60 * len(markers), 3)),
    )  # fmt: skip
    B = arm.model.regressor(rows, arm.x).B
    open_ = [k for k, name in enumerate(arm.model.names) if name not in kept]
    known = [k for k, name in enumerate(arm.model.names) if name in kept]
    mixing = np.linalg.lstsq(B[:, known], B[:, open_], rcond=1e-9)[0]
    typical = np.array([arm.model.parameters[k].typical for k in open_])
    left = OpenParameters(tuple(arm.model.names[k] for k in open_), mixing, typical)
    arm = replace(arm, determined=kept, covariance=1e-12 * np.eye(n), left=left)
    targets = targets_at("t", None, None, "base", None, q=POSTURES)
    marker = compensate(arm, targets, tool_point(cell, "M1"))
    assert np.all(marker.uncertainty.unknown < 1e-9)
    place = compensate(arm, targets, tool_point(cell, "0.1,0.2,0.3"))
    assert np.all(place.uncertainty.unknown > 1e-3)
    assert any("link6." in told and "`point`" in told for told in place.warnings)


def test_random_poses_of_the_demo_arm_are_reached_without_joints_given():
    chain = kr270_chain()
    cell = kr270_cell(EVERYWHERE)
    arm = calibrated(chain, cell)
    arm = replace(arm, x=erring(arm.model, np.random.default_rng(6)))
    q = 0.7 * random_poses(chain, 12, 7)
    q = q[np.abs(q[:, 4]) > 0.3]
    T = nominal_flanges(chain, q)
    position = T[:, :3, 3] + T[:, :3, :3] @ cell.tool.markers["M1"]
    found = compensate(
        arm, targets_at("t", position, T[:, :3, :3], "base", DOWN), tool_point(cell, "M1")
    )
    assert found.reached.sum() >= len(q) - 1
    miss, turn = tool_errors(arm, found)
    assert miss[found.reached].max() < FARTHEST and turn[found.reached].max() < FARTHEST


def test_too_soft_an_arm_has_no_equilibrium():
    nominal = Nominal(joint_compliance=(1e-3,) * 6)
    cell = kr270_cell(("joint_compliance",), nominal=nominal)
    arm = calibrated(kr270_chain(), cell)
    found = compensate(
        arm, targets_at("t", None, None, "base", DOWN, q=POSTURES[:2]), tool_point(cell, "M1")
    )
    assert set(found.status) == {"no equilibrium"}
    assert np.isnan(found.after).all()
