"""The whole identification, from nothing: what it finds lies where its intervals say."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from support.calibration import (
    GEOMETRY,
    SPRINGS,
    binomial_band,
    cell_of,
    covered,
    measured,
    random_chain,
    table_at,
    true_values,
    with_values,
    z_scores,
)
from support.cells import COMPLIANCE, kr270_chain, random_poses
from support.robots import packaged_urdf

from elastocal.cell_tables import CartesianNoise, Nominal, Tracker
from elastocal.identification.identify import identify
from elastocal.identification.mistakes import nominal_fit
from elastocal.identification.solve import reduce
from elastocal.messages import InsufficientDataError
from elastocal.model.manipulator import Model
from elastocal.model.urdf import read_urdf
from elastocal.simulation import simulate

SIGMA = 5e-5
LOADS = [[0, 0, 0], [0, 0, -2600], [800, 0, -2600]]


def assert_one_arm_is_covered(result, truth):
    """The joint ellipsoid of all estimates at 99.9 %: a test of one arm, correlations included."""
    z, std = z_scores(result, truth), np.sqrt(np.diag(result.covariance))
    squared = z @ np.linalg.solve(result.covariance / np.outer(std, std), z) / len(z)
    assert squared < stats.f.isf(1e-3, len(z), result.dof)


def test_six_compliances_and_the_geometry_lie_within_their_intervals():
    """With base, tool and markers free."""
    known = {"M1": np.array([0.25, 0.05, 0.1]), "M2": np.array([-0.1, 0.2, 0.15])}
    chain, at = kr270_chain(), {"load_point": (0.2, 0.0, 0.25)}
    nominal = Nominal(joint_compliance=COMPLIANCE)
    true = Model.assembled(chain, cell_of(SPRINGS, known, nominal=nominal, **at))
    model = Model.assembled(chain, cell_of(SPRINGS, dict.fromkeys(known, np.zeros(3)), **at))
    springs = [f"joint{i}.compliance" for i in range(1, 7)]
    hits = 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        truth = true_values(true, rng)
        plan = table_at(random_poses(true.chain, 16, seed), LOADS, ("M1", "M2"))
        result = identify(model, measured(true, plan, truth, SIGMA, rng))
        assert result.converged and set(springs) <= set(result.determined)
        assert_one_arm_is_covered(result, truth)
        hits += covered(result, truth, springs).sum()
    assert hits >= binomial_band(12, 0.95)[0]


@pytest.mark.parametrize("stated", [True, False])
def test_pose_observation(stated):
    chain = random_chain(3, 5)
    tracker = Tracker(noise=CartesianNoise(np.full(3, SIGMA)), rotation_sigma=1e-4)
    effects = (*GEOMETRY, "marker_orientation")
    true = Model.assembled(chain, cell_of(effects, tracker=tracker, observe="pose"))
    model = true if stated else Model.assembled(chain, cell_of(effects, observe="pose"))
    rng = np.random.default_rng(3)
    truth = true_values(true, rng)
    rows = [true.names.index(f"marker:M1.r{k}") for k in "xyz"]
    truth[rows] = Rotation.random(random_state=3).as_rotvec()
    plan = table_at(random_poses(chain, 30, 3))
    table = simulate(true, replace(plan, rotation=np.zeros((30, 3))), truth, rng)
    result = identify(model, table)
    assert result.noise.kind == ("stated" if stated else "independent")
    if stated:  # s² · dof is χ²(dof)
        low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], result.dof)
        assert low < result.noise.ratio_to_stated**2 * result.dof < high
    assert_one_arm_is_covered(result, truth)
    for wrong, cause in (
        (-table.rotation, "transpose them"),
        ((read := Rotation.from_rotvec(table.rotation)).as_euler("ZYX"), "about the moving z, y"),
        (Rotation.from_quat(np.roll(read.as_quat(), -1, axis=1)).as_rotvec(), "hold x, y, z, w:"),
        ((Rotation.from_euler("x", np.pi / 2) * read).as_rotvec(), "turned by (90, 0, 0)°"),
    ):
        with pytest.raises(InsufficientDataError, match=f"rotations are .*{re.escape(cause)}"):
            identify(model, turned := replace(table, rotation=wrong))
        assert cause in nominal_fit(chain, model.cell, turned).warning
    assert not nominal_fit(chain, model.cell, table).warning


def test_distance_observation():
    chain = random_chain(0, 4)
    effects = ("distance_sensor", "marker_position", "joint_offset")
    model = Model.assembled(chain, cell_of(effects, observe="distance"))
    rng = np.random.default_rng(0)
    truth = with_values(model, {
        "tracker.anchor_x": 1.2, "tracker.anchor_y": -0.8, "tracker.anchor_z": 0.5,
        "tracker.length_offset": 0.05, "marker:M1.x": 0.1, "marker:M1.y": -0.05,
        "joint2.offset": 1e-3, "joint3.offset": -2e-3, "joint4.offset": 1e-3,
    })  # fmt: skip
    table = measured(model, table_at(random_poses(chain, 60, 0)), truth, 1e-4, rng)
    result = identify(model, table)
    # joint 1's offset turns everything about an axis, the anchor included
    assert not result["joint1.offset"].identifiable
    assert_one_arm_is_covered(result, truth)


def test_error_on_new_poses_is_the_cramer_rao_prediction():
    """UR10, 1 mm and 1 mrad of errors, 0.05 mm of noise, six arms: rms error on 200 noise-free
    poses against √(tr B cov Bᵀ / 200) of the minimal complete set, within 15 %."""
    chain = read_urdf((ur10 := packaged_urdf("UR10"))[0], flange=ur10[1])
    model = Model.assembled(chain, cell_of(GEOMETRY))
    errors, bounds = [], []
    wide = table_at(random_poses(chain, 200, 999))
    at = model.regressor(wide).B
    kept = reduce(at, model.sizes(at), model.parameters, 1.0, 0.0).kept
    for seed in range(6):
        truth = true_values(model, rng := np.random.default_rng([seed, 30]))
        plan = table_at(random_poses(chain, 30, 300 + seed))
        result = identify(model, measured(model, plan, truth, SIGMA, rng))
        exact = model.regressor(wide, truth, kept)
        B = model.regressor(plan, truth, kept).B
        scale = np.linalg.norm(B, axis=0)
        cov = np.linalg.inv((B / scale).T @ (B / scale)) * SIGMA**2
        bounds.append(np.einsum("ij,jk,ik->", exact.B / scale, cov, exact.B / scale) / 200)
        errors.append(np.sum((model.predict(wide, result.x) - exact.prediction) ** 2) / 200)
    assert np.sqrt(np.mean(errors) / np.mean(bounds)) == pytest.approx(1.0, abs=0.15)
