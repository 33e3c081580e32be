"""The whole identification, from nothing: what it finds lies where its intervals say."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from support.calibration import (
    BASE,
    GEOMETRY,
    PLACED,
    SPRINGS,
    binomial_band,
    cell_of,
    covered,
    measured,
    planar_chain,
    random_chain,
    table_at,
    true_values,
    with_values,
    z_scores,
)
from support.cells import COMPLIANCE, kr270_chain, random_poses
from support.robots import packaged_urdf

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.solve import reduce
from elastocal.model.manipulator import Model
from elastocal.model.urdf import read_urdf
from elastocal.simulation import simulate

SIGMA = 5e-5
KR270_LOADS = [[0, 0, 0], [0, 0, -2600], [800, 0, -2600]]


def kr270_models(markers=2):
    """Truth with markers somewhere on the flange and Table 3's compliances; a model that knows
    neither tool nor base nor any nominal compliance."""
    where = {"M1": [0.25, 0.05, 0.1], "M2": [-0.1, 0.2, 0.15]}
    known = {k: np.array(v) for k, v in list(where.items())[:markers]}
    unknown = {k: np.zeros(3) for k in known}
    load_point = (0.2, 0.0, 0.25)
    nominal = Nominal(joint_compliance=COMPLIANCE)
    true = Model.assembled(
        kr270_chain(), cell_of(SPRINGS, known, load_point=load_point, nominal=nominal)
    )
    return true, Model.assembled(kr270_chain(), cell_of(SPRINGS, unknown, load_point=load_point))


def in_share(counts, sizes, p=0.95, level=1e-3):
    """Whether a mean share of `counts`/`sizes` over seeds agrees with p at `level`.

    Intervals of one arm are correlated, so seeds are the units: a t test of their shares.
    """
    share = np.asarray(counts) / np.asarray(sizes)
    half = stats.t.isf(level / 2, len(share) - 1) * share.std(ddof=1) / np.sqrt(len(share))
    return abs(share.mean() - p) <= half


def assert_one_arm_is_covered(result, truth, names=()):
    """The joint ellipsoid of all estimates at 99.9 %: a test of one arm, correlations included."""
    z = z_scores(result, truth)
    std = np.sqrt(np.diag(result.covariance))
    rho = result.covariance / np.outer(std, std)
    chosen = [result.determined.index(n) for n in (names or result.determined)]
    z, rho = z[chosen], rho[np.ix_(chosen, chosen)]
    squared = z @ np.linalg.solve(rho, z) / len(z)
    assert squared < stats.f.isf(1e-3, len(z), result.dof)


# --- (a) geometry and compliance together, base, tool and markers free ------------------------


def kr270_coverage(seeds, poses):
    true, model = kr270_models()
    springs = [f"joint{i}.compliance" for i in range(1, 7)]
    inside, sizes, spring_hits = [], [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        truth = true_values(true, rng)
        plan = table_at(random_poses(true.chain, poses, seed), KR270_LOADS, ("M1", "M2"))
        result = identify(model, measured(true, plan, truth, SIGMA, rng))
        assert result.converged and set(springs) <= set(result.determined)
        hit = covered(result, truth)
        inside.append(hit.sum())
        sizes.append(len(hit))
        spring_hits.append(covered(result, truth, springs))
    return inside, sizes, np.array(spring_hits)


def check_coverage(inside, sizes, spring_hits):
    share = 100 * sum(inside) / sum(sizes)
    print(f"\n95 % intervals that hold the truth: {sum(inside)} of {sum(sizes)} ({share:.1f} %), "
          f"of compliances {spring_hits.sum()} of {spring_hits.size}")  # fmt: skip
    assert in_share(inside, sizes)
    low, high = binomial_band(spring_hits.size, 0.95)
    assert low <= spring_hits.sum() <= high
    # each joint on its own, Bonferroni over six
    low, _ = binomial_band(len(spring_hits), 0.95, 1 - 0.001 / 6)
    assert (spring_hits.sum(axis=0) >= low).all()


def test_six_compliances_and_the_geometry_lie_within_their_intervals():
    check_coverage(*kr270_coverage(range(4), poses=16))


@pytest.mark.long
def test_six_compliances_and_the_geometry_lie_within_their_intervals_over_40_arms():
    check_coverage(*kr270_coverage(range(100, 140), poses=25))


def test_vertical_load_alone_leaves_joint_1_undetermined():
    """The KR 270's first axis is vertical, the tracker level: nothing shows its compliance."""
    marker = {"M1": np.array([0.1, 0.2, 0.1])}
    model = Model.assembled(
        kr270_chain(), cell_of(("joint_compliance",), marker, nominal=Nominal(COMPLIANCE))
    )
    rng = np.random.default_rng(0)
    plan = table_at(random_poses(model.chain, 20, 0), KR270_LOADS[:2])
    result = identify(model, measured(model, plan, model.nominal, SIGMA, rng))
    first = result["joint1.compliance"]
    assert not first.identifiable and first.value is first.std is first.ci95 is None
    assert result.determined == tuple(f"joint{i}.compliance" for i in range(2, 7))
    assert_one_arm_is_covered(result, model.nominal)


# --- (b) … (f) other observations and arms ----------------------------------------------------


LEVELS = (-0.3, -0.9, -1.6, -2.2)


def levelled_plan(chain, seed, n=24):
    q = random_poses(chain, n, seed)
    q[:, 1] = np.resize(LEVELS, n)
    return table_at(q, KR270_LOADS, ("M1",))


COMPENSATOR = {
    "joint": "joint2", "stiffness_N_per_m": 1e6, "anchor_m": (0.686, 0.120), "arm_m": 0.185,
    "free_length_m": 0.458,
}  # fmt: skip


def test_compliance_by_levels_from_deflections_with_a_known_compensator():
    """Each level its own truth; the compensator acts and its nominal values are right."""
    chain = kr270_chain()
    nominal = Nominal(joint_compliance=COMPLIANCE, gravity_compensator=COMPENSATOR)
    cell = cell_of(
        ("joint_compliance", "gravity_compensator"), observe="deflection",
        compliance_levels={"joint2": LEVELS}, nominal=nominal,
    )  # fmt: skip
    model = Model.assembled(chain, cell)
    rng = np.random.default_rng(1)
    truth = true_values(model, rng)
    table = measured(model, levelled_plan(chain, 1), truth, 1e-5, rng)
    result = identify(model, table, Options(fixed=("gravity_compensator",)))
    for i in range(1, 5):
        assert result[f"joint2.compliance_level{i}"].identifiable
    assert result["joint2.compensator_stiffness"].note == "fixed by the user"
    assert_one_arm_is_covered(result, truth)


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
    assert len(result.residual) == 180


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_distance_observation(seed):
    chain = random_chain(seed, 4)
    effects = ("distance_sensor", "marker_position", "joint_offset")
    model = Model.assembled(chain, cell_of(effects, observe="distance"))
    rng = np.random.default_rng(seed)
    truth = with_values(model, {
        "tracker.anchor_x": 1.2, "tracker.anchor_y": -0.8, "tracker.anchor_z": 0.5,
        "tracker.length_offset": 0.05, "marker:M1.x": 0.1, "marker:M1.y": -0.05,
        "joint2.offset": 1e-3, "joint3.offset": -2e-3, "joint4.offset": 1e-3,
    })  # fmt: skip
    table = measured(model, table_at(random_poses(chain, 120, seed)), truth, 1e-4, rng)
    result = identify(model, table)
    # joint 1's offset turns everything about an axis, the anchor included
    assert not result["joint1.offset"].identifiable
    assert_one_arm_is_covered(result, truth)


# --- (g) invariance ---------------------------------------------------------------------------


@lru_cache
def springs_case(seed=0, poses=20):
    chain = planar_chain()
    effects = (*GEOMETRY, "joint_compliance")
    true = Model.assembled(
        chain, cell_of(effects, nominal=Nominal((2e-5,) * 3), load_point=(0.1, 0.1, 0.1))
    )
    rng = np.random.default_rng(seed)
    truth = true_values(true, rng)
    loads = [[0, 0, 0], [0, 0, -400], [150, 100, -400]]
    plan = table_at(random_poses(chain, poses, seed), loads)
    return true, measured(true, plan, truth, SIGMA, rng), truth


def test_turning_and_moving_the_tracker_changes_nothing():
    """Positions and forces in another frame: the same arm, the same residuals.

    Loads are dead forces without link weights, so even the vertical may turn.
    """
    model, table, _ = springs_case()
    R, shift = Rotation.random(rng=0), np.array([2.0, -1.0, 0.7])
    moved = replace(table, position=R.apply(table.position) + shift, force=R.apply(table.force))
    a, b = identify(model, table), identify(model, moved)
    turned_back = R.inv().apply(b.residual.reshape(-1, 3)).ravel()
    # both fits stop within 1e-4 of a standard deviation of their minimum
    np.testing.assert_allclose(turned_back, a.residual, atol=1e-3 * SIGMA)
    assert b.residual_rms == pytest.approx(a.residual_rms, rel=1e-6)
    for i in range(1, 4):
        one, two = (r[f"joint{i}.compliance"] for r in (a, b))
        std = np.sqrt(a.covariance[(k := a.determined.index(one.name)), k])
        assert abs(one.held - two.held) < 0.01 * std
    assert a.dof == b.dof


# --- (h) prediction ---------------------------------------------------------------------------


def test_held_out_rms_is_what_new_poses_show():
    """40 poses held out one by one against 300 new ones, noise included in both.

    Squares of 120 (900) components: relative standard errors of the rms of 7 % (2.4 %); 4 of
    them together."""
    model = Model.assembled(kr270_chain(), cell_of(GEOMETRY))
    rng = np.random.default_rng(4)
    truth = true_values(model, rng)
    table, other = (
        measured(model, table_at(random_poses(model.chain, n, s)), truth, SIGMA, rng)
        for n, s in ((40, 4), (300, 5))
    )
    result = identify(model, table, test=other)
    assert result.test.n == 300
    assert result.test.rms == pytest.approx(result.heldout_rms, rel=4 * np.hypot(0.07, 0.024))
    assert result.residual_rms < result.heldout_rms < result.nominal_rms
    error = (other.position.ravel() - model.predict(other, result.x)).reshape(-1, 3)
    length = np.linalg.norm(error, axis=1)
    assert result.test.rms == pytest.approx(np.sqrt(np.mean(length**2)))
    assert result.test.mean == pytest.approx(length.mean())
    assert result.test.maximum == pytest.approx(length.max())


# --- (i) Cramér–Rao ---------------------------------------------------------------------------


@pytest.mark.parametrize("poses", [30, pytest.param(100, marks=pytest.mark.long)])
def test_error_on_new_poses_is_the_cramer_rao_prediction(poses):
    """UR10, 1 mm and 1 mrad of errors, 0.05 mm of noise, six arms: rms error on 200 noise-free
    poses against √(tr B cov Bᵀ / 200) of the minimal complete set, within 15 %."""
    path, flange = packaged_urdf("UR10")
    chain = read_urdf(path, flange=flange)
    model = Model.assembled(chain, cell_of(GEOMETRY))
    errors, bounds = [], []
    wide = table_at(random_poses(chain, 200, 999))
    at = model.regressor(wide).B
    kept = reduce(at, model.sizes(at), model.parameters, 1.0, 0.0).kept
    for seed in range(6):
        rng = np.random.default_rng([seed, poses])
        truth = true_values(model, rng)
        plan = table_at(random_poses(chain, poses, 10 * poses + seed))
        result = identify(model, measured(model, plan, truth, SIGMA, rng))
        exact = model.regressor(wide, truth, kept)
        B = model.regressor(plan, truth, kept).B
        scale = np.linalg.norm(B, axis=0)
        cov = np.linalg.inv((B / scale).T @ (B / scale)) * SIGMA**2
        bounds.append(np.einsum("ij,jk,ik->", exact.B / scale, cov, exact.B / scale) / 200)
        errors.append(np.sum((model.predict(wide, result.x) - exact.prediction) ** 2) / 200)
    assert np.sqrt(np.mean(errors) / np.mean(bounds)) == pytest.approx(1.0, abs=0.15)


# --- (j), (k) the user's say --------------------------------------------------------------------


def test_fixing_the_base_at_its_hint():
    """Base position and attitude given and held: used exactly, the rest identified."""
    R = Rotation.random(random_state=5)
    nominal = Nominal(base_position=np.array([1.0, 2.0, 3.0]), base_rotation=R.as_matrix())
    model = Model.assembled(planar_chain(), cell_of(GEOMETRY, nominal=nominal))
    rng = np.random.default_rng(5)
    truth = true_values(model, rng)
    truth[[model.names.index(n) for n in BASE]] = [1.0, 2.0, 3.0, *R.as_rotvec()]
    table = measured(model, table_at(random_poses(model.chain, 25, 5)), truth, SIGMA, rng)
    result = identify(model, table, Options(fixed=("base_frame",)))
    held = [result[name].held for name in BASE]
    np.testing.assert_allclose(held, [1.0, 2.0, 3.0, *R.as_rotvec()], atol=1e-12)
    assert_one_arm_is_covered(result, truth)


# --- (l) the result -----------------------------------------------------------------------------


def test_json_of_a_result_with_infinities_is_still_json():
    """A marker read once has no held-out residual; no test table was given."""
    markers = {"M1": np.zeros(3), "M2": np.array([0.1, 0.1, 0.0])}
    model = Model.assembled(planar_chain(), cell_of(PLACED, markers))
    rng = np.random.default_rng(0)
    plan = table_at(random_poses(model.chain, 12, 0), markers=("M1", "M2"))
    plan = plan.take((plan.marker == 0) | (plan.configuration == 4))
    truth = true_values(model, rng)
    result = identify(model, measured(model, plan, truth, SIGMA, rng))
    found = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert found["heldout_rms_um"] is None and found["test"] is None
    assert found["residual_rms_um"] > 0


def test_the_same_input_gives_the_same_result():
    model, table, _ = springs_case()
    a, b = identify(model, table), identify(model, table)
    assert np.array_equal(a.x, b.x) and np.array_equal(a.covariance, b.covariance)
