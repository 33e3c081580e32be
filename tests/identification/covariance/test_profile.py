"""Profile-likelihood intervals: exact cases (t, transformed t, Fieller), ends, a real model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.calibration import SPRINGS, cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.cell.arm_description import Nominal
from elastocal.errors import ElastocalError, InputError
from elastocal.identification.intervals import profile_interval, profile_of
from elastocal.identification.least_squares import FitProblem, fit
from elastocal.identification.weighted_problem import weights_for
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe


def least(B, y):
    """(x, rss) of the least-squares fit."""
    x = np.linalg.lstsq(B, y, rcond=None)[0]
    return x, float(np.sum((y - B @ x) ** 2))


def line(seed, slope=1.0, n=12):
    rng = np.random.default_rng(seed)
    B = np.column_stack([np.ones(n), np.linspace(-1, 2, n)])
    return B, B @ [0.8, slope] + 0.3 * rng.normal(size=n)


@pytest.mark.parametrize("level", [0.5, 0.999])
@pytest.mark.parametrize("index", [1])
def test_a_linear_model_has_its_t_interval(index, level):
    B, y = line(0)
    x, rss = least(B, y)

    def objective(value):
        return least(np.delete(B, index, axis=1), y - value * B[:, index])[1]

    std = np.sqrt(rss / 10 * np.linalg.inv(B.T @ B)[index, index])
    half = stats.t.ppf((1 + level) / 2, 10) * std
    found = profile_interval(objective, x[index], 1.7 * std, 10, level)  # std only sets the scale
    np.testing.assert_allclose(
        [found.lower, found.upper], [x[index] - half, x[index] + half], atol=1e-5 * half
    )
    assert found.ends == ("crossing", "crossing")


def test_follows_any_transformation():
    """A stiffness is the reciprocal of a compliance, and so is its interval; far from symmetric."""

    def objective(compliance):
        return 5.0 + ((compliance - 1.0) / 0.3) ** 2

    direct = profile_interval(objective, 1.0, 0.3, 5)
    inverse = profile_interval(lambda k: objective(1 / k), 1.0, 0.3, 5)
    assert inverse.upper - 1 > 2 * (1 - inverse.lower)
    np.testing.assert_allclose([1 / inverse.upper, 1 / inverse.lower],
                               [direct.lower, direct.upper], rtol=1e-5)  # fmt: skip


def ratio(seed, slope):
    """Where a line crosses zero, θ = −b₀/b₁, by its profile, and Fieller's set (low, high)."""
    B, y = line(seed, slope)
    (b0, b1), rss = least(B, y)
    s2, v = rss / 10, np.linalg.inv(B.T @ B)
    F = stats.f.ppf(0.95, 1, 10) * s2
    # (b₀ + θ b₁)² ≤ F (v₀₀ + 2θ v₀₁ + θ² v₁₁)
    roots = np.roots([b1**2 - F * v[1, 1], 2 * (b0 * b1 - F * v[0, 1]), b0**2 - F * v[0, 0]])
    theta = -b0 / b1
    gradient = np.array([-1 / b1, b0 / b1**2])
    std = np.sqrt(s2 * gradient @ v @ gradient)

    def objective(value):
        return least((B[:, 1] - value)[:, None], y)[1]

    return profile_interval(objective, theta, std, 10), np.sort(roots), theta


def test_equals_fieller():
    """The profile interval of a ratio is Fieller's (1954), in closed form."""
    found, fieller, theta = ratio(3, slope=0.8)
    assert found.ends == ("crossing", "crossing")
    np.testing.assert_allclose([found.lower, found.upper], fieller, rtol=1e-5)
    assert not np.isclose(fieller.sum() / 2, theta, rtol=0.02)


def test_a_flat_side_is_unbounded_and_said():
    """A slope that may be zero: Fieller's set is the outside of its roots, so one side of the
    crossing runs to infinity."""
    found, fieller, theta = ratio(1, slope=0.12)
    assert np.iscomplexobj(fieller) or theta < fieller[0] or theta > fieller[1]
    assert "unbounded" in found.ends
    flat = found.ends.index("unbounded")
    assert np.isinf([found.lower, found.upper][flat])


def parabola(value):
    return 10.0 + (value - 1.0) ** 2


def test_bounds_end_the_interval():
    t = stats.t.ppf(0.975, 10)
    found = profile_interval(parabola, 1.0, 1.0, 10, lower=0.5, upper=1 + 2 * t)
    assert found.lower == 0.5 and found.ends == ("bound", "crossing")
    assert found.upper == pytest.approx(1 + t, abs=1e-5)
    at = profile_interval(parabola, 1.0, 1.0, 10, lower=1.0)
    assert at.lower == 1.0 and at.ends[0] == "bound"


@pytest.mark.parametrize("fails", ["raises", "infinite"])
def test_where_no_fit_exists_the_interval_ends(fails):
    """Also far below the quantile, and without disturbing a crossing on the other side."""

    def objective(value):
        if value > 1.6:
            if fails == "raises":
                raise ElastocalError("no equilibrium")
            return np.inf
        return parabola(value)

    found = profile_interval(objective, 1.0, 1.0, 10)
    assert found.ends == ("crossing", "no_fit")
    assert found.upper == pytest.approx(1.6, abs=1e-5)
    assert found.lower == pytest.approx(1 - stats.t.ppf(0.975, 10), abs=1e-5)


def test_a_better_fit_elsewhere_is_an_error():
    with pytest.raises(ElastocalError, match="fit again from there"):
        profile_interval(parabola, 2.0, 0.3, 10)


def test_bad_input_is_told():
    for std in (0.0, np.nan, np.inf):
        with pytest.raises(InputError, match="std"):
            profile_interval(parabola, 1.0, std, 10)
    with pytest.raises(InputError, match="degrees of freedom"):
        profile_interval(parabola, 1.0, 1.0, 0)
    with pytest.raises(InputError, match="outside its bounds"):
        profile_interval(parabola, 1.0, 1.0, 10, lower=1.5)
    with pytest.raises(InputError, match="level"):
        profile_interval(parabola, 1.0, 1.0, 10, level=95)
    with pytest.raises(InputError, match="no residual"):
        profile_interval(lambda value: (value - 1) ** 2, 1.0, 1.0, 10)


FITTED = ("joint2.compliance", "joint3.compliance", "joint2.offset", "joint3.offset")


def arm(names=FITTED, sigma=5e-5):
    """A loaded planar arm, the named parameters fitted to noisy readings, the rest at the truth."""
    nominal = Nominal(joint_compliance=(2e-5,) * 3)
    model = Model.assembled(planar_chain(3), cell_of(SPRINGS, nominal=nominal))
    table = table_at(random_poses(model.chain, 8, 0), [[0, 0, 0], [0, 0, -500.0]])
    rng = np.random.default_rng(1)
    truth = true_values(model, rng, anywhere=False)
    observed = observe(measured(model, table, truth, sigma, rng), "position")
    columns = np.array([model.names.index(name) for name in names])
    sizes = model.sizes(model.regressor(observed.table, truth, None, observed).B)
    weights = weights_for(observed, model.cell.tracker, "none")
    problem = FitProblem(model, observed, weights, truth, columns, sizes)
    return problem, fit(problem)


@pytest.mark.parametrize("names", [FITTED, FITTED[:1]])
def test_the_arm_is_nearly_linear(names):
    """Over a few standard deviations the arm bends by parts in a thousand: S rises as δ²/C_jj
    with the cofactor C of the fit, and the interval is that of t.  With one column nothing is
    left to refit."""
    problem, found = arm(names)
    dof = len(found.whitened) - len(found.columns)
    variance = found.whitened @ found.whitened / dof
    std = float(np.sqrt(variance * np.linalg.inv(found.B.T @ found.B)[0, 0]))
    objective = profile_of(problem, found, problem.columns[0])
    estimate = found.x[problem.columns[0]]
    least = objective(estimate)
    assert least == pytest.approx(found.whitened @ found.whitened, rel=1e-9)
    for z in (-2.0, 1.0, 3.0):
        rise = (objective(estimate + z * std) - least) / (least / dof)
        assert rise == pytest.approx(z**2, rel=2e-2)
    profile = profile_interval(objective, estimate, std, dof)
    half = stats.t.ppf(0.975, dof) * std
    ends = [estimate - half, estimate + half]
    np.testing.assert_allclose([profile.lower, profile.upper], ends, atol=2e-2 * std)


def test_refits_beat_holding_the_others():
    """S(value) is the minimum over the others: below S with them held, and where gradients of
    the others vanish."""
    problem, found = arm()
    j = problem.columns[0]
    value = found.x[j] * 1.2
    x = found.x.copy()
    x[j] = value
    observed = problem.observations
    held = observed.value - problem.model.predict(observed.table, x, observed)
    rss = profile_of(problem, found, j)(value)
    assert rss < 0.99 * held @ held
    start = replace(problem, x=x, columns=problem.columns[1:])
    again = fit(replace(start, x=x + 1e-4 * np.isin(np.arange(len(x)), problem.columns[1:])))
    assert rss == pytest.approx(again.whitened @ again.whitened, rel=1e-9)


def test_a_profile_needs_a_fitted_parameter_without_ties():
    problem, found = arm()
    with pytest.raises(InputError, match="was not fitted"):
        profile_of(problem, found, 0)
    tied = replace(problem, tie=np.ones(4))
    with pytest.raises(InputError, match="ties"):
        profile_of(tied, found, problem.columns[0])


def test_rounding_at_the_end_of_the_t_interval_is_no_crossing_of_its_own():
    """The refits of a linear problem end at t exactly, on this side of it or on that."""
    seen = set()

    def objective(value):
        rounding = 1e-9 if value in seen else -1e-9
        seen.add(value)
        return parabola(value) + (rounding if value != 1.0 else 0.0)

    found = profile_interval(objective, 1.0, 1.0, 10)
    t = stats.t.ppf(0.975, 10)
    assert [found.lower, found.upper] == pytest.approx([1 - t, 1 + t], abs=1e-5)
    assert found.ends == ("crossing", "crossing")
