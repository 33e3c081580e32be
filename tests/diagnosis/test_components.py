"""Many causes at once: the likelihood of a sum, what each earns, lines, shares, and answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support.diagnosis_data import campaign, dense_noise, diagnosed, random_data, used_rows

from elastocal.diagnosis import (
    Component,
    FittedSum,
    NoiseValues,
    NoisyData,
    Sizes,
    component_search,
    fit_sum,
    posed,
    with_returned,
)
from elastocal.diagnosis.baseline import Blocks, fit_baseline
from elastocal.diagnosis.component_answer import PROBABLE, TOLD, SumAnswer
from elastocal.diagnosis.component_search import WIDE, Beside, evidence_beside, promised
from elastocal.diagnosis.diagnose import diagnose
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.evidence import direct
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.noise_floor import project
from elastocal.model.effects.gears import EncoderScale
from elastocal.model.effects.smooth import JointCurve, Waves

Array = np.ndarray
NOISE = NoiseValues(1.1, np.array([2e-6, 4e-6, 3e-6]), np.full(3, 0.4))


def component(data: NoisyData, seed: int, k: int, smooth: bool = False) -> Component:
    """Random columns that move the readings by some 1e-5 m."""
    rng = np.random.default_rng((seed, 11))
    columns = 1e-5 * rng.normal(size=(*data.r.shape, k))
    if not smooth:
        return Component("angle", EncoderScale(), f"joint{seed}", columns, fellows=8)
    waves = Waves(0.0, np.arange(1.0, k // 2 + 1))
    return Component(
        "angle", JointCurve(), f"joint{seed}", columns, waves=waves, lengths=(-2.0, 1.0)
    )


def some(seed: int = 3) -> tuple[NoisyData, list[Component], Sizes]:
    data = random_data(seed)
    components = [component(data, 1, 2), component(data, 2, 6, smooth=True), component(data, 3, 1)]
    sizes = Sizes(0.2, np.array([0.3, -0.4, 0.1]), np.array([0.0, -0.7, 0.0]))
    return data, components, sizes


def rows_of(data: NoisyData, packed: Array) -> Array:
    return packed.reshape(-1, packed.shape[2])[used_rows(data)]


def dense(data: NoisyData, components: list[Component], at: Sizes) -> Array:
    """The covariance of all readings, the data's own columns integrated out too."""
    V = np.exp(2 * at.factor) * dense_noise(data, NOISE)
    X = rows_of(data, data.X)
    V += X @ np.diag(1 / data.precision) @ X.T
    for c, s, length in zip(components, at.size, at.length, strict=True):
        C = rows_of(data, c.columns)
        V += C @ np.diag(np.exp(2 * s) * c.shares(length)[0]) @ C.T
    return V


def test_the_likelihood_is_that_of_a_normal_distribution() -> None:
    data, components, at = some()
    problem = posed(data, components, NOISE)
    r = data.r.ravel()[used_rows(data)]
    expected = multivariate_normal(np.zeros(len(r)), dense(data, components, at)).logpdf(r)
    assert -problem.factored(at)[2] / 2 == pytest.approx(expected, abs=1e-6)


def test_the_information_is_the_average_of_the_dense_gaussian() -> None:
    """rᵀPV_iPV_jPr and the prior's curvatures; V_i by differences of the dense covariance."""
    data, components, at = some()
    theta, K, h = np.concatenate([[at.factor], at.size, at.length]), len(components), 1e-5

    def covariance(theta: Array) -> Array:
        return dense(data, components, Sizes(theta[0], theta[1 : K + 1], theta[K + 1 :]))

    inverse = np.linalg.inv(covariance(theta))
    u = inverse @ data.r.ravel()[used_rows(data)]
    moved = [(covariance(theta + s) - covariance(theta - s)) @ u / (2 * h)
             for s in h * np.eye(len(theta))]  # fmt: skip
    expected = np.array([[a @ inverse @ b for a in moved] for b in moved])
    problem = posed(data, components, NOISE)
    expected[1 : K + 1, 1 : K + 1] += 2 * problem.pool.precision
    expected[0, 0] += 8.0 if data.stated else 0.0
    np.testing.assert_allclose(problem.objective(theta)[2], expected, rtol=1e-5, atol=1e-5)


def test_the_slope_is_that_of_the_value() -> None:
    data, components, at = some()
    problem = posed(data, components, NOISE)
    theta = np.concatenate([[at.factor], at.size, at.length])
    slope = problem.objective(theta)[1]
    for k in range(len(theta)):
        if slope[k] == 0.0:  # the length of what has none
            continue
        step = 1e-5 * np.eye(len(theta))[k]
        ends = [problem.objective(theta + sign * step)[0] for sign in (1, -1)]
        assert slope[k] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-5)


def test_what_a_component_earns_is_what_the_likelihood_loses_without_it() -> None:
    data, components, at = some()
    problem = posed(data, components, NOISE)
    whole, (earned, within) = problem.factored(at)[2], problem.earned(at)
    assert not within.any()
    for k in range(len(components)):
        kept = [i for i in range(len(components)) if i != k]
        fewer = posed(data, [components[i] for i in kept], NOISE)
        lost = (fewer.factored(at.chosen(kept))[2] - whole) / 2
        assert earned[k] == pytest.approx(lost, abs=1e-6)


def test_a_compliance_below_zero_is_no_cause() -> None:
    """Evidence of a half Gaussian: of what is positive twice as much, of what is not next to none,
    and so it is not in the sum."""
    h = next(h for h in possible(*campaign(n=20))[0] if h.effect.name == "base_compliance")
    data = random_data(5, p=2)
    unit = np.tile(1e-14 * np.eye(data.r.shape[1]), (len(data.r), 1, 1))
    data = replace(data, left_out=data.left_out & False, covariance=unit)
    free, quiet = component(data, 1, 1), NOISE.of_instrument()
    half = replace(free, hypothesis=replace(h, parameters=h.parameters[:1]))
    assert half.bounded.tolist() == [0] and not free.bounded.any()
    noise = 1e-7 * np.random.default_rng(7).normal(size=data.r.shape)

    def sums(w: float) -> list[FittedSum]:
        read = replace(data, r=w * free.columns[..., 0] + noise)
        return [fit_sum(read, [c], quiet, refit_noise=False) for c in (free, half)]

    (either, positive), (negative, none) = sums(1.0), sums(-1.0)
    assert positive.score - either.score == pytest.approx(np.log(2), abs=1e-6)
    assert positive.earned[0] - either.earned[0] == pytest.approx(np.log(2), abs=1e-6)
    assert negative.components and not none.components


def test_sums_that_are_known_serve_another_fit() -> None:
    """A component more and one less, and the noise larger by a factor, as if summed anew."""
    data, components, at = some()
    known = posed(data, components, NOISE)
    other = [components[2], component(data, 4, 3), components[0]]
    twice, anew = posed(data, other, NOISE, known), posed(data, other, NOISE)
    np.testing.assert_allclose(twice.weighted.M, anew.weighted.M, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(twice.weighted.z, anew.weighted.z, rtol=1e-9, atol=1e-12)
    larger = known.scaled(0.3)
    expected = posed(data, components, larger.noise)
    np.testing.assert_allclose(larger.weighted.M, expected.weighted.M, rtol=1e-9)
    assert larger.factored(at)[2] == pytest.approx(expected.factored(at)[2], abs=1e-6)


def test_evidence_beside_a_sum_is_that_of_the_rows() -> None:
    data, components, _ = some()
    r = data.r + sum(c.columns @ np.full(c.width, 20.0) for c in components)
    found = fit_sum(replace(data, r=r), components, NOISE, refit_noise=False)
    assert len(found.components) == 3
    more = [component(data, 4, 2).columns, component(data, 5, 3).columns]
    beside = Beside(found, more)
    for k, gone in enumerate(found.spans):
        kept = np.r_[0 : gone.start, gone.stop : found.data.X.shape[2]]
        rest = replace(found.data, X=found.data.X[:, :, kept], precision=found.data.precision[kept])
        at = project(rest, found.noise)
        tried = [found.components[k].columns, *more]
        expected = [float(direct(data.masked(C), at).evidence(WIDE)[0]) for C in tried]
        assert beside.evidence(gone, [gone, *beside.spans]) == pytest.approx(expected, rel=1e-6)
    # Without directions that hardly show the rest of the readings is as probable.
    shown = project(found.without_these(), found.noise).marginal
    assert shown == pytest.approx(project(found.data, found.noise).marginal, abs=1e-3)


def test_what_components_promise_counts_once_what_two_of_them_say() -> None:
    """Of one it is its evidence, of another besides what that has beside the first; a copy, or one
    of which the readings say nothing, promises nothing more."""
    data = random_data(5, p=2)
    data = replace(data, left_out=data.left_out & False, r=0 * data.r)
    each = 1e-14 * np.eye(data.r.shape[1])
    data = replace(data, covariance=np.tile(each, (len(data.r), 1, 1)))
    first, second, idle = (component(data, k, 1) for k in (1, 2, 3))
    quiet = NoiseValues.usual(3).of_instrument()
    r = 1e-7 * np.random.default_rng(3).normal(size=data.r.shape)
    r = r + first.columns @ np.array([0.01]) + second.columns @ np.array([0.01])
    data = replace(data, r=r)
    chosen = ModelSet((), quiet, data, 0.0, ())
    at = project(data, quiet)
    own = [float(direct(c.columns, at).evidence(WIDE)[0]) for c in (first, second, idle)]
    assert promised(chosen, [first]) == pytest.approx(own[0])
    both = promised(chosen, [first, second, idle])
    assert both == pytest.approx(own[0] + own[1], rel=0.2) and both > own[0] > 20 > 5 * own[2]
    assert promised(chosen, [first, replace(first), second]) == pytest.approx(both, rel=0.05)


def test_where_no_sum_is_promised_none_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """One effect: the answer is that of a diagnosis which looks for a sum all the same."""
    model, table = campaign("gear_eccentricity:joint4")
    said: list[str] = []
    short = diagnose(model, table, progress=said.append)
    assert not any("components at once" in line for line in said)
    monkeypatch.setattr(component_search, "PROMISING", -1.0)
    longer = diagnose(model, table, progress=said.append)
    assert any("components at once" in line for line in said)
    assert short.verdict == longer.verdict == "explained" and short.effects == longer.effects


def test_scatter_of_joints_that_the_instrument_has_taken_is_found() -> None:
    """Nothing is stated: beside so much noise of the instrument the likelihood is flat where joints
    repeat well."""
    blocks = Blocks.of(np.repeat(np.arange(80), 2), np.arange(160), 3)
    data = random_data(6, blocks, p=2, stated=False)
    rng = np.random.default_rng(2)
    scatter = data.same_visit @ (2e-4 * rng.normal(size=(*data.r.shape, 3)))
    r = 2e-5 * rng.normal(size=data.r.shape) + (data.G * scatter).sum(axis=2)
    start = NoiseValues(30.0, np.full(3, 1e-9), np.full(3, 0.2))
    found = fit_sum(replace(data, r=r), [component(data, 1, 2)], start)
    assert (found.noise.joint > 1e-4).all()


def test_of_causes_only_those_at_work_are_left() -> None:
    """Readings that two of ten components make: these are found, at their sizes."""
    data = random_data(5, p=2)
    rng = np.random.default_rng(8)
    data = replace(data, left_out=data.left_out & False, r=0 * data.r)
    components = [component(data, k, 3) for k in range(1, 11)]
    # Readings without padding: noise of the usual size.
    noise = 1e-7
    data = replace(
        data, covariance=np.tile(np.eye(data.r.shape[1]), (len(data.r), 1, 1)) * noise**2
    )
    true = {1: np.array([1.5, -1.0, 0.8]), 4: np.array([-0.7, 1.2, 2.0])}
    r = noise * rng.normal(size=data.r.shape)
    for k, w in true.items():
        r = r + components[k].columns @ w
    found = fit_sum(replace(data, r=r), components, NoiseValues.usual(3).of_instrument(),
                    refit_noise=False)  # fmt: skip
    assert {id(c) for c in found.components} == {id(components[k]) for k in true}
    assert np.exp(found.sizes.size) == pytest.approx([1.1, 1.4], rel=0.5)


def test_what_the_columns_of_others_are_about_stays() -> None:
    data, components, _ = some()
    quiet = NoiseValues.usual(3).of_instrument()
    free = fit_sum(replace(data, r=0 * data.r), components[:1], quiet, refit_noise=False)
    given = replace(components[0], given=True)
    held = fit_sum(replace(data, r=0 * data.r), [given], quiet, refit_noise=False)
    assert not free.components and held.components == (given,)


def test_a_smooth_function_is_tried_at_several_lengths() -> None:
    """Beside a sum its evidence is that of the length that suits it best."""
    data, components, _ = some()
    smooth = next(c for c in components if c.waves is not None)
    low, high = smooth.lengths
    assert low < high and len(smooth.scalings) == 3
    for scaling, length in zip(smooth.scalings, (low, (low + high) / 2, high), strict=True):
        np.testing.assert_allclose(scaling, np.sqrt(smooth.shares(length)[0]))
    found = fit_sum(data, [c for c in components if c is not smooth], NOISE, refit_noise=False)
    beside = Beside(found, [smooth.columns * scaling for scaling in smooth.scalings])
    best = max(beside.evidence(slice(0, 0), beside.spans))
    assert evidence_beside(found, [smooth]) == pytest.approx([best])


def test_nothing_is_found_in_noise() -> None:
    count = 0
    for seed in range(6):
        data = random_data(seed, p=2)
        rng = np.random.default_rng((seed, 3))
        V = data.covariance
        K = np.linalg.cholesky(V + 1e-30 * np.eye(V.shape[1]))
        data = replace(data, r=(K @ rng.normal(size=(*data.r.shape, 1)))[:, :, 0])
        components = [component(data, k, 2) for k in range(1, 9)]
        quiet = NoiseValues.usual(3).of_instrument()
        count += len(fit_sum(data, components, quiet, refit_noise=False).components)
    assert count <= 2


MANY = (
    "gear_eccentricity:joint2",
    "gear_eccentricity:joint4",
    "gear_ripple:joint5",
    "encoder_scale:joint3",
    "off_axis_compliance:joint3",
    "tracker_distortion:tracker",
)


@pytest.mark.long
def test_many_effects_at_once_are_one_sum() -> None:
    d = diagnosed(*MANY, n=60)
    assert len(d.components) >= 4
    assert sum(c.share for c in d.components) == pytest.approx(1.0, abs=0.05)
    assert {"joint2", "joint4", "joint5"} <= {c.where for c in d.components if c.family == "angle"}
    assert d.gap.explained < 0.5 * d.gap.calibrated
    assert d.groups[0].share == max(g.share for g in d.groups)
    shares = {(name, c.where): c.share for c in d.components for name in c.effects}
    assert not {(e.effect, e.where) for e in d.effects} & {(e.effect, e.where) for e in d.slight}
    for e in d.effects:
        assert e.probability >= PROBABLE or abs(shares[e.effect, e.where]) >= TOLD


def test_the_campaign_of_many_has_their_model() -> None:
    model, table = campaign(*MANY, n=20)
    assert len(table) == 20 * 2 * 3 and not any(p.shrunk for p in model.parameters)


def test_what_went_under_a_larger_noise_comes_back() -> None:
    """A small cause beside a large one that was not known yet."""
    data = random_data(5, p=2)
    data = replace(data, left_out=data.left_out & False, r=0 * data.r)
    each = 1e-14 * np.eye(data.r.shape[1])
    data = replace(data, covariance=np.tile(each, (len(data.r), 1, 1)))
    large, small = component(data, 1, 3), component(data, 2, 1)
    r = 1e-7 * np.random.default_rng(8).normal(size=data.r.shape)
    r = r + large.columns @ np.array([30.0, -20.0, 25.0]) + small.columns @ np.array([0.1])
    data, quiet = replace(data, r=r), NoiseValues.usual(3).of_instrument()
    found = fit_sum(data, [large], quiet, refit_noise=False)
    again = with_returned(found, [large, small])
    assert {id(c) for c in again.components} == {id(large), id(small)}


def answer_without_components(every: bool) -> SumAnswer:
    """Of a campaign whose joint 5 has another error in every configuration, of `every` visit or of
    the unloaded ones alone."""
    model, table = campaign(n=40)
    table = table if every else table.take((table.force == 0).all(axis=1))
    dataset = diagnosis_data_of(fit_baseline(model, table), possible(model, table)[0])
    errors = 2e-4 * np.random.default_rng(0).normal(size=len(dataset.data.r))
    data = replace(dataset.data, r=dataset.data.r + dataset.data.G[:, :, 4] * errors[:, None])
    dataset = dataset.changed(data=data)
    found = fit_sum(data, [], NoiseValues.usual(6))
    return SumAnswer(dataset, dataset, found, (), np.random.default_rng(1))


def test_what_a_joint_errs_by_at_every_configuration_is_its_angle_s() -> None:
    """It has a row without a name, of the size that it has."""
    answer = answer_without_components(every=True)
    (row,) = answer.components
    assert (row.family, row.where, row.named) == ("angle", "joint5", False)
    errors = 2e-4 * np.random.default_rng(0).normal(size=40)
    moved = answer.dataset.data.G[:, :, [4]] * errors[:, None, None]
    left = answer._followed(moved[answer._rows])
    true = float(np.sqrt((left**2).sum() / answer._readings))
    assert row.rms_ci95[0] < true < row.rms_ci95[1] < 1.3 * row.rms_ci95[0]
    assert row.share > 0.9 and row.probability > 0.99


def test_without_visits_again_nothing_is_called_an_error_of_the_angle() -> None:
    """What repeats is not told from what does not."""
    assert not answer_without_components(every=False).components
