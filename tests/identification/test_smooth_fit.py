"""Smooth functions in the whole identification, on a small arm whose joints have error curves."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats
from support.calibration import PLACED, cell_of, covered, measured, planar_chain, table_at

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.errors import InputError
from elastocal.identification.identify import identify
from elastocal.identification.knowledge import GaussianPrior, non_negative
from elastocal.identification.options import Options
from elastocal.identification.smooth_part import SmoothPart
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe, subset
from elastocal.model.smooth_groups import SmoothGroup, smooth_groups
from elastocal.units import Array

SIGMA = 2e-5  # m
SIZE, LENGTH, HALF = 5e-4, 0.5, 2.0
CURVE = {
    "curve_size_rad": SIZE, "curve_length_rad": LENGTH, "curve_low_rad": -HALF,
    "curve_high_rad": HALF,
}  # fmt: skip
JOINTS = ("joint1", "joint2", "joint3")
EFFECTS = (*PLACED, "joint_offset", *(f"joint_curve:{joint}" for joint in JOINTS))


@lru_cache
def arm(*effects: str, size: float = SIZE) -> Model:
    """Three joints with error curves; the marker 0.1 m off the last axis."""
    settings = {joint: CURVE | {"curve_size_rad": size} for joint in JOINTS}
    cell = cell_of(
        effects or EFFECTS, {"M1": np.array([0.1, 0.05, 0.1])},
        nominal=Nominal(settings=settings),
    )  # fmt: skip
    return Model.assembled(planar_chain(), cell)


def true(model: Model, rng: np.random.Generator, curves: float = 1.0) -> Array:
    """Offsets of 1 mrad, and curves drawn from their prior, times `curves`."""
    x = model.nominal.copy()
    for i, p in enumerate(model.parameters):
        if p.shrunk:
            x[i] = curves * float(p.typical or 0.0) * rng.normal()
        elif p.effect == "joint_offset":
            x[i] = 1e-3 * rng.normal()
    return x


def readings(
    model: Model, x: Array, n: int, rng: np.random.Generator, sigma: float = SIGMA
) -> Measurements:
    table = table_at(rng.uniform(-HALF, HALF, (n, 3)))
    return measured(model, table, x, sigma, rng)


@lru_cache
def campaign(seed: int = 1, n: int = 80, curves: float = 1.0):
    """Model, truth, readings, others for a test, and the calibration."""
    model, rng = arm(), np.random.default_rng(seed)
    x = true(model, rng, curves)
    table, test = readings(model, x, n, rng), readings(model, x, 200, rng, 0.0)
    return model, x, table, test, identify(model, table, test=test)


def test_new_poses_are_predicted_to_the_noise():
    _model, _x, table, test, fit = campaign()
    plain = identify(arm(*PLACED, "joint_offset"), table, test=test)
    assert fit.converged and fit.method == "reml"
    assert plain.test.rms > 3e-4, "the curves are large"
    assert fit.test.rms < 0.15 * plain.test.rms
    assert np.isclose(fit.heldout_rms, np.hypot(fit.test.rms, SIGMA * 3**0.5), rtol=0.6)
    assert np.isclose(fit.noise.sigma or 0.0, SIGMA, rtol=0.25)
    assert len(fit.smooth) == 3 and all(0.1 < part.scale < 10 for part in fit.smooth)


def test_every_parameter_stands_in_the_result_and_functions_stand_together():
    model, _, _, _, fit = campaign()
    assert tuple(fit) == model.names
    assert {e.name for e in fit.ordinary} == {p.name for p in model.parameters if not p.shrunk}
    content = fit.to_json()
    assert [p["name"] for p in content["parameters"]] == list(model.names)
    entries = content["smooth"]
    assert [entry["where"] for entry in entries] == list(JOINTS)
    for entry, part in zip(entries, fit.smooth, strict=True):
        assert entry["effect"] == "joint_curve" and entry["follows"] == entry["where"]
        assert entry["size"] == SIZE and entry["length"] == LENGTH
        low, high = entry["rms_ci95"]
        assert 0 < low <= entry["rms"] <= high < 5 * SIZE
        assert 3 < entry["effective"] < part.coefficients == entry["coefficients"]
    # The offsets have a prior as well, and are worth less than one parameter each.
    curves = sum(part.effective for part in fit.smooth)
    placed = sum(not name.startswith("joint") for name in fit.determined)
    assert 0 < len(fit.residual) - curves - placed - fit.dof < len(JOINTS)
    assert set(fit.prior_share) == {f"{joint}.offset" for joint in JOINTS}


def test_the_band_of_a_curve_holds_the_true_one():
    inside = []
    for seed in range(3):
        _model, x, _, _, fit = campaign(seed)
        for part in fit.smooth:
            grid, value, half = part.shape()
            truth = replace(part, value=x[part.group.columns]).shape()[1]
            inside.append((np.abs(value - truth) <= half).mean())
            assert grid[0] == -HALF and grid[-1] == HALF
    assert np.mean(inside) > 0.85


def test_held_out_residuals_are_those_of_refits():
    """Leaving out a configuration for good: prior and noise as found, on the model itself."""
    model, rng = arm(*(e for e in EFFECTS if e != "joint_offset")), np.random.default_rng(0)
    table = readings(model, true(model, rng), 40, rng)
    options = Options(method="ols", faulty="keep")
    fit = identify(model, table, options)
    observed = observe(table, model.observe)
    columns = np.array([model.names.index(name) for name in fit.determined])
    prior = np.zeros(len(columns))
    for part in fit.smooth:
        for c in part.group.columns.ravel():
            if c in columns:
                typical = float(model.parameters[c].typical or 0.0)
                prior[columns == c] = fit.sigma**2 / (part.scale * typical**2)
    B = model.regressor(table, fit.x, columns, observed).B
    # About the fit: the prior pulls by where each parameter stands.
    stands = fit.x[columns] * (prior > 0)
    for left in (0, 7, 23):
        keep = np.ones(len(observed.lead), dtype=bool)
        keep[left] = False
        rows = np.repeat(keep, 3)
        normal = B[rows].T @ B[rows] + np.diag(prior)
        step = np.linalg.solve(normal, B[rows].T @ fit.residual[rows] - prior * stands)
        expected = fit.residual[~rows] - B[~rows] @ step
        assert np.allclose(fit.held_out[~rows], expected, rtol=0.02, atol=2e-8)
    assert len(subset(observed, keep).lead) == 39


def test_ordinary_intervals_beside_curves_hold_the_truth():
    hits = []
    for seed in range(12):
        model, x, _, _, fit = campaign(seed) if seed < 3 else campaign_of(seed)
        names = [n for n in fit.determined if not model.parameters[model.names.index(n)].shrunk]
        hits += covered(fit, x, names).tolist()
    low = stats.binom.ppf(0.001, len(hits), 0.93)
    assert sum(hits) >= low, f"{sum(hits)} of {len(hits)}"


def campaign_of(seed: int):
    model, rng = arm(), np.random.default_rng(seed)
    x = true(model, rng)
    table = readings(model, x, 60, rng)
    return model, x, table, None, identify(model, table)


def test_nothing_is_claimed_where_there_are_no_curves():
    model, rng = arm(), np.random.default_rng(7)
    x = true(model, rng, curves=0.0)
    table, test = readings(model, x, 60, rng), readings(model, x, 200, rng, 0.0)
    fit = identify(model, table, test=test)
    plain = identify(arm(*PLACED, "joint_offset"), table, test=test)
    assert fit.test.rms < 1.15 * plain.test.rms + 1e-6
    assert sum(part.effective for part in fit.smooth) < 8
    gone = [part for part in fit.smooth if part.scale == 0]
    for part in gone:
        assert (part.value == 0).all() and (part.covariance == 0).all()
        assert any(part.group.name in told for told in fit.warnings)
        note = fit[model.names[part.group.columns[0, 0]]].note
        assert "do not show" in note


def test_a_curve_that_is_larger_than_stated_is_fitted_all_the_same():
    model, rng = arm(size=SIZE / 5), np.random.default_rng(8)
    x = true(arm(), rng)
    table, test = readings(model, x, 80, rng), readings(model, x, 200, rng, 0.0)
    fit = identify(model, table, test=test)
    assert all(part.scale > 3 for part in fit.smooth)
    assert fit.test.rms < 6e-5


def test_faulty_readings_are_judged_beside_the_curves():
    """0.3 mm hide in what curves of 0.5 mrad leave a model without them, not beside them."""
    model, _x, table, test, clean = campaign()
    position = np.asarray(table.position).copy()
    position[[5, 40]] += [[3e-4, 0, 0], [0, 0, -4e-4]]
    fit = identify(model, replace(table, position=position), test=test)
    assert {o.line for o in fit.excluded} == set(table.row[[5, 40]])
    assert not clean.faulty
    assert fit.test.rms < 1.2 * clean.test.rms


def test_readings_of_one_place_that_agree_are_no_errors():
    """A bend that only a few neighbouring poses see: the model lacks something there."""
    model, x, table, *_ = campaign()
    q = table.q.copy()
    q[:3] = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 1e-3]]) + np.array([1.9, 1.9, -1.9])
    rng = np.random.default_rng(3)
    moved = measured(model, replace(table, q=q), x, SIGMA, rng)
    position = np.asarray(moved.position).copy()
    position[:3] += [8e-4, 8e-4, 8e-4]
    fit = identify(model, replace(moved, position=position))
    assert not set(table.row[:3]) & {o.line for o in fit.excluded}


def test_readings_without_noise_are_no_reason_to_fail():
    model, x, _, test, _ = campaign()
    fit = identify(model, readings(model, x, 80, np.random.default_rng(2), 0.0), test=test)
    assert fit.test.rms < 5e-5


def test_stated_noise_and_plain_weights_are_taken_as_they_are():
    model, _x, table, test, _ = campaign()
    for method in ("ols", "wls"):
        noise = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))
        known = Model.assembled(model.chain, replace(model.cell, tracker=noise))
        fit = identify(known, table, Options(method=method), test=test)
        assert fit.method == method and fit.test.rms < 6e-5
        if method == "wls":
            assert 0.7 < (fit.noise.ratio_to_stated or 0.0) < 1.3


@pytest.mark.parametrize("method", ["huber", "tukey", "eq14"])
def test_methods_without_a_prior_are_refused(method):
    model, _, table, *_ = campaign()
    with pytest.raises(InputError, match="smooth functions"):
        identify(model, table, Options(method=method))


@lru_cache
def corner():
    """Geometry and curves fitted in a corner of the joints' ranges, and tested there and beyond."""
    effects = (*EFFECTS, "link_geometry")
    model, rng = arm(*effects), np.random.default_rng(3)
    x = true(model, rng)
    for i, p in enumerate(model.parameters):
        if p.effect == "link_geometry":
            x[i] += float(p.typical or 0.0) * rng.normal()
    drawn = ((0.6, 1.0, 100, SIGMA), (0.6, 1.0, 100, 0.0), (-HALF, HALF, 200, 0.0))
    near, inside, far = (
        measured(model, table_at(rng.uniform(low, high, (n, 3))), x, sigma, rng)
        for low, high, n, sigma in drawn
    )
    return identify(model, near, test=inside), identify(model, near, test=far)


def test_far_from_what_was_measured_geometry_stays_within_its_sizes():
    """A minimal set, the rest at nominal, errs there by centimetres."""
    inside, far = corner()
    assert inside.test.rms < 2 * SIGMA * 3**0.5
    assert far.test.rms < 3e-3  # lengths of 1 mm, angles of 1 mrad, curves
    assert all(far.prior_share[f"link{k}.dz"] > 0.9 for k in (1, 2))


def test_the_result_says_where_it_was_not_measured():
    inside, far = corner()
    assert inside.test.p_far > 0.01 and inside.finding("test_data_far") is None
    assert far.test.p_far < 1e-9 and far.test.far > 100
    told = far.finding("test_data_far")
    assert told is not None and told.numbers["far"] == far.test.far
    assert far.test.std > 2 * inside.test.std > 0
    assert far.to_json()["test"]["far"] == far.test.far
    assert far.to_json()["measured_poses"]["configurations"] == 100
    assert far.arm.shown.most == pytest.approx(inside.arm.shown.most, rel=1e-9)


def test_intervals_without_a_prior_are_refused():
    model, _, table, *_ = campaign()
    with pytest.raises(InputError, match="smooth functions"):
        identify(model, table, Options(intervals="cr2"))


def test_a_stated_prior_joins_that_of_the_curves():
    model, x, table, test, plain = campaign()
    name = "joint2.offset"
    truth = x[model.names.index(name)]
    prior = GaussianPrior.independent((name,), [truth], [1e-6])
    fit = identify(model, table, Options(prior=prior), test=test)
    assert abs(fit[name].value - truth) < 3e-6 and fit.prior_share[name] > 0.5
    assert not [n for n in fit.prior_share if "curve" in n]
    assert fit.test.rms < 1.1 * plain.test.rms
    assert np.isclose(fit.dof, plain.dof, atol=5)


def test_bounds_on_ordinary_parameters_do_not_profile_the_curves():
    _model, _x, table, *_ = campaign()
    effects = (*EFFECTS, "joint_compliance:joint2")
    elastic = arm(*effects)
    fit = identify(elastic, table, Options(constraints=non_negative("joint2.compliance")))
    assert fit["joint2.compliance"].held >= 0


def test_a_bounded_fit_holds_what_ends_beyond_its_bound():
    _, _, table, _test, plain = campaign()
    elastic = arm(*EFFECTS, "joint_compliance:joint2")
    force = np.tile([0.0, 0.0, -50.0], (len(table), 1))
    fit = identify(elastic, replace(table, force=force), Options(bounded=True))
    assert fit["joint2.compliance"].held >= 0
    assert fit.heldout_rms < 1.3 * plain.heldout_rms


def test_functions_may_be_fixed():
    model, _x, table, *_ = campaign()
    fit = identify(model, table, Options(fixed=("joint_curve",)))
    assert not fit.smooth and fit.heldout_rms > 2e-4
    two = identify(model, table, Options(fixed=("joint3.curve_1",)))
    assert two["joint3.curve_1"].note == "fixed by the user" and len(two.smooth) == 3


def test_a_field_that_follows_time_needs_it_and_is_of_one_campaign():
    settings = {"base": {
        "field_time_size": 3e-4, "field_time_length": 600.0, "field_time_low": 0.0,
        "field_time_high": 3600.0,
    }}  # fmt: skip
    cell = cell_of(
        (*PLACED, "joint_offset", "residual_field:base"), {"M1": np.array([0.1, 0.05, 0.1])},
        nominal=Nominal(settings=settings),
    )  # fmt: skip
    model, rng = Model.assembled(planar_chain(), cell), np.random.default_rng(0)
    (group,) = smooth_groups(model)
    assert not group.lasting and group.columns.shape[0] == 6
    x = true(model, rng)
    table = replace(
        table_at(rng.uniform(-HALF, HALF, (120, 3))), time=np.linspace(0.0, 3600.0, 120)
    )
    fit = identify(model, measured(model, table, x, SIGMA, rng))
    assert (
        fit.heldout_rms
        < 0.7
        * identify(
            model, measured(model, table, x, SIGMA, rng), Options(fixed=("residual_field",))
        ).heldout_rms
    )
    units = [entry["unit"] for entry in fit.to_json()["smooth"]]
    assert units == ["m", "rad"]


def test_the_size_of_lines_is_the_root_of_their_sum_of_squares() -> None:
    """They are no function of one quantity whose mean square could be taken."""
    value, sd = np.array([[3e-5, -4e-5, 1e-6, 0.0]]), 1e-7
    columns, nan = np.arange(4)[None], np.nan
    group = SmoothGroup("gear_spectrum", "joint1", "", columns, ("rad",), 5e-5, nan, nan, nan, None)
    part = SmoothPart(group, 1.0, 4.0, value, np.eye(4) * sd**2, np.zeros(0))
    size, (low, high), half = part.sizes["rad"]
    assert size == pytest.approx(np.linalg.norm(value), rel=1e-2) and low < size < high
    assert half == pytest.approx(1.96 * 2 * sd, rel=1e-2)
