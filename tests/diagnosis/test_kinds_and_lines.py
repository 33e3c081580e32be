"""What acts at many joints at once: the prior of kinds, kinds made whole, orders of lines; and how
fast the base drifts."""

from __future__ import annotations

from dataclasses import replace
from math import comb, exp, log

import numpy as np
import pytest
from support.diagnosis_data import campaign, random_data

from elastocal.diagnosis import Component, NoiseValues, NoisyData, fit_baseline
from elastocal.diagnosis.component_families import (
    LineFamily,
    drifts,
    family_component,
    line_families,
    sharpened,
    shorter,
    with_multiples,
)
from elastocal.diagnosis.component_search import (
    PROBABLE,
    completed,
    hidden_fellows,
    size_of_fellows,
    with_expected_families,
    with_likelier_orders,
    with_own_axes,
    with_shorter_drifts,
)
from elastocal.diagnosis.components import (
    PRESENT,
    Pool,
    fit_sum,
    given_fellows,
    log_odds,
    presence_cost,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.line_orders import (
    KnownFamily,
    OrderPosterior,
    log_prior_of,
    order_posterior,
    ripples,
)
from elastocal.model.effects.gears import EncoderScale, GearEccentricity

QUIET = NoiseValues.usual(3).of_instrument()
QUIET6 = NoiseValues.usual(6).of_instrument()


def plain_data() -> NoisyData:
    """Two fitted columns under noise of unit variance, no residual yet."""
    data = random_data(5, p=2)
    unit = np.tile(np.eye(data.r.shape[1]), (len(data.r), 1, 1))
    return replace(data, left_out=data.left_out & False, covariance=unit, r=0 * data.r)


def fellow(k: int, columns: np.ndarray, effect: type = EncoderScale) -> Component:
    return Component("angle", effect(), f"joint{k + 1}", columns, fellows=6)


@pytest.mark.parametrize("n", [1, 2, 6, 9])
def test_a_kind_is_there_with_its_prior_probability_at_whatever_places(n: int) -> None:
    there = sum(comb(n, k) * exp(-presence_cost(n, k)) for k in range(1, n + 1))
    assert there == pytest.approx(PRESENT / (1 - PRESENT))


def test_a_cost_is_that_of_leaving_one_out() -> None:
    columns = np.zeros((1, 1, 1))
    some = [fellow(k, columns) for k in range(4)]
    some += [fellow(k, columns, GearEccentricity) for k in range(2)]
    pool = Pool(some)
    for k in range(len(some)):
        others = Pool([*some[:k], *some[k + 1 :]])
        assert pool.costs[k] == pytest.approx(pool.cost - others.cost)
        sizes = np.linspace(-1.0, 1.5, len(some))
        less = others.penalty(np.delete(sizes, k))[0]
        lost = pool.penalties(sizes)[k]
        assert lost == pytest.approx((pool.penalty(sizes)[0] - less) / 2)
        (own,) = [kind for kind in pool.kinds if k in kind]
        mean, precision = given_fellows(sizes[own[own != k]])
        assert lost == pytest.approx(precision * (sizes[k] - mean) ** 2 / 2)
    # The last of a kind costs less than the first, and may be expected.
    assert log_odds(some, fellow(4, columns)) > log_odds([], fellow(4, columns))


@pytest.mark.parametrize("few_poses", [300, 0])
def test_many_of_a_kind_come_in_together_where_none_would_alone(
    few_poses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("elastocal.diagnosis.component_search.FEW_POSES", few_poses)
    data, rng = plain_data(), np.random.default_rng(3)
    p = data.X.shape[2]
    # Six directions at right angles to each other and to the fitted columns; noise in all others.
    whole = np.hstack([data.X.reshape(-1, p), rng.normal(size=(data.r.size, 6))])
    basis = np.linalg.qr(whole)[0]
    noise = rng.normal(size=data.r.size)
    noise -= basis @ (basis.T @ noise)
    columns = basis[:, p:].T.reshape(6, *data.r.shape, 1)
    data = replace(data, r=noise.reshape(data.r.shape) + 3.6 * columns.sum(axis=0)[..., 0])
    some = [fellow(k, columns[k]) for k in range(6)]
    assert not fit_sum(data, some[:1], QUIET, refit_noise=False).components
    together = fit_sum(data, some, QUIET, refit_noise=False)
    assert len(together.components) == 6
    # From a part of them the others are found, also where another kind stands for one of them.
    stranger = fellow(0, columns[0], GearEccentricity)
    begun = fit_sum(data, some[1:4], QUIET, refit_noise=False)
    start = begun if len(begun.components) == 3 else together
    assert len(completed(start, [*some, stranger]).components) == 6


def test_what_cannot_be_seen_is_reckoned_with_where_its_fellows_are() -> None:
    data, rng = plain_data(), np.random.default_rng(3)
    columns = rng.normal(size=(5, *data.r.shape, 1))
    some = [fellow(k, columns[k]) for k in range(5)]
    r = rng.normal(size=data.r.shape) + 10 * columns.sum(axis=0)[..., 0]
    found = fit_sum(replace(data, r=r), some, QUIET, refit_noise=False)
    assert len(found.components) == 5
    sixth = fellow(5, 1e-9 * columns[0])
    stranger = fellow(5, 1e-9 * columns[0], GearEccentricity)
    (hidden,) = hidden_fellows(found, [*some, sixth, stranger])
    assert hidden.where == "joint6" and hidden.effect.name == EncoderScale.name
    size = np.sqrt(np.mean(np.exp(2 * found.sizes.size)))
    assert hidden is sixth
    assert size_of_fellows(found, hidden) == pytest.approx(np.log(size))


@pytest.mark.parametrize("worse", [1.0, 3.0])
def test_an_instrument_that_states_nothing_may_read_one_axis_worse(worse: float) -> None:
    """It is seen beside the sum; where all axes are alike nothing changes."""
    data, rng = plain_data(), np.random.default_rng(4)
    data = replace(data, stated=False)
    axis = np.arange(data.r.shape[1]) % data.blocks.size
    sigma = np.sqrt(np.diagonal(data.covariance, axis1=1, axis2=2)) * np.where(
        axis == 0, worse, 1.0
    )
    columns = rng.normal(size=(*data.r.shape, 1)) * sigma[..., None]
    r = sigma * rng.normal(size=data.r.shape) + 10 * columns[..., 0]
    found = fit_sum(replace(data, r=r), [fellow(0, columns)], QUIET, refit_noise=False)
    own = with_own_axes(found)
    if worse == 1.0:
        assert own is found
    else:
        variance = np.diagonal(own.sums.data.covariance, axis1=1, axis2=2)[0]
        ratio = np.sqrt(variance[axis == 0].mean() / variance[axis == 1].mean())
        assert ratio == pytest.approx(worse, rel=0.25)
        assert own.score > found.score + 5.0


@pytest.fixture(scope="module")
def rippled() -> DiagnosisData:
    """Sixty poses of an arm whose joint 5 has a ripple of order 81.3."""
    model, table = campaign("gear_ripple:joint5", n=60, sigma=2e-5)
    hypotheses, _ = possible(model, table)
    return diagnosis_data_of(fit_baseline(model, table), hypotheses)


def test_orders_of_lines_are_found_beside_each_other(rippled: DiagnosisData) -> None:
    """And how well each is known is honest; nothing is expected of joints that have none."""
    start = fit_sum(rippled.data, [], rippled.noise)
    assert with_expected_families(rippled, start) is start
    best = line_families(rippled, start)[0]
    assert best.where == "joint5" and best.gain > 10
    found = fit_sum(rippled.data, [best.component], start.noise)
    again = sharpened(rippled, found) or list(found.components)
    settings = dict(again[0].settings)
    order, sd = settings["order_1"], settings["order_sd_1"]
    assert sd < 0.2 and abs(order - 81.3 / round(81.3 / order)) < 4 * sd
    one = with_multiples(rippled, again[0]).get(1, again[0])
    orders = [dict(one.settings)["order_1"]]
    orders += [dict(with_multiples(rippled, one)[3].settings)[f"order_{k}"] for k in (2, 3)]
    assert orders == pytest.approx([order, 2 * order, 3 * order])
    assert with_expected_families(rippled, found) is found


LINED = {"joint1": 24.3, "joint3": 17.8, "joint4": 31.4, "joint5": 40.65}


@pytest.fixture(scope="module")
def lined(rippled: DiagnosisData) -> tuple[DiagnosisData, dict[str, Component]]:
    """Four joints with families of two lines each, of similar sizes, and noise as stated."""
    families = {
        w: family_component(rippled, LineFamily(w, order, 2, 0.0, 0.02, 7.0))
        for w, order in LINED.items()
    }
    rng, data = np.random.default_rng(4), rippled.data
    root = np.linalg.cholesky(data.covariance)
    r = (root @ rng.normal(size=(*data.r.shape, 1)))[:, :, 0]
    for c in families.values():
        amplitudes = rng.normal(size=c.width) * np.tile([0.8, 0.8, 0.0, 0.0], 2)
        r = r + c.columns @ amplitudes
    return rippled.changed(data=replace(data, r=r)), families


def test_what_other_joints_have_is_expected_of_the_next(
    lined: tuple[DiagnosisData, dict[str, Component]],
) -> None:
    """With k of n joints odds of k + 1 to n − k; its order is that of the readings, and joints
    without lines get none."""
    dataset, families = lined
    h = next(h for h in ripples(dataset) if h.where == "joint5")
    chances = []
    for k in (1, 3):
        some = [families[w] for w in list(LINED)[:k]]
        found = fit_sum(dataset.data, some, QUIET6, refit_noise=False)
        assert len(found.components) == k
        orders = order_posterior(dataset, found, h)
        assert orders.presence == pytest.approx(log((k + 1) / (6 - k)))
        order, _ = orders.best
        assert order == pytest.approx(LINED["joint5"], abs=orders.resolution)
        chances.append(orders.probability(order))
        assert orders.log_odds.size == orders.orders.size
    assert chances[1] > PROBABLE
    wider = with_expected_families(dataset, found)
    assert {c.where for c in wider.components} == set(LINED)
    again = fit_sum(dataset.data, wider.components, wider.noise, wider.sizes)
    assert len(again.components) == len(LINED)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_half_an_order_or_twice_it_is_put_right(
    lined: tuple[DiagnosisData, dict[str, Component]], ratio: float
) -> None:
    """And lines that are not there go."""
    dataset, families = lined
    wrong = LineFamily("joint3", ratio * LINED["joint3"], 3, 0.0, 0.02, 7.0)
    some = [c for w, c in families.items() if w != "joint3"]
    some.append(replace(family_component(dataset, wrong), given=True))
    found = fit_sum(dataset.data, some, QUIET6, refit_noise=False)
    better = with_likelier_orders(dataset, found)
    (c,) = (c for c in better.components if c.where == "joint3")
    assert dict(c.settings)["order_1"] == pytest.approx(LINED["joint3"], abs=0.1)
    assert len(c.settings) // 2 == 2
    assert better.score > found.score


def test_a_next_line_is_as_probable_as_other_joints_have_it() -> None:
    """Prior over orders and numbers of lines sums to one; of n families that k have the third."""
    unit = 0.2
    grid = [np.arange(2.5, 250.0 / m, 0.5 * unit / m) for m in (1, 2, 3)]
    orders, lines = np.concatenate(grid), np.repeat([1, 2, 3], [len(g) for g in grid])
    for third in range(4):
        fellows = [KnownFamily(f"joint{k}", 20.0 + k, 3 if k < third else 2, 0.0) for k in range(3)]
        prior = np.exp(log_prior_of(orders, lines, unit, fellows))
        assert prior.sum() == pytest.approx(1.0, abs=0.02)
        at = [prior[(lines == m) & (np.abs(orders - 20.0) < 5.0)].sum() for m in (2, 3)]
        assert at[1] / at[0] == pytest.approx((third + 1) / (4 - third), rel=0.05)
        # Those of other joints are where an order is looked for first.
        assert prior[np.abs(orders - 20.0) < 5.0].sum() > 2 * prior[orders > 100.0].sum()


@pytest.mark.parametrize("share", [0.07, 0.6])
def test_a_drift_is_as_fast_as_the_readings_show(share: float) -> None:
    """Of the campaign's time; one that a slow drift explains stays as it is."""
    model, table = campaign(n=60)
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    (slow,) = drifts(dataset)
    span = float(np.ptp(table.time))
    fast = slow
    while (finer := shorter(dataset, fast, fast.lengths[0])) is not None:
        assert finer.lengths[0] < fast.lengths[0] and finer.width > fast.width
        fast = finer
    spread = 2 * np.sqrt(fast.shares(np.log(share * span))[0])
    drift = fast.columns @ (spread * np.random.default_rng(2).normal(size=fast.width))
    data = replace(dataset.data, r=dataset.data.r + drift)
    begun = fit_sum(data, [slow], dataset.noise, refit_noise=False)
    found = with_shorter_drifts(dataset, begun)
    if share > np.exp(slow.lengths[0]) / span:
        assert found is begun
    else:
        assert found.score > begun.score + 10
        assert np.exp(found.sizes.length[0]) == pytest.approx(share * span, rel=0.5)


def test_a_line_is_as_probable_as_all_families_that_have_it(rippled: DiagnosisData) -> None:
    """Alone, or the second one of half its order: neither is more probable than not, the line is.
    And of a family whose multiples are open the first line is the one to have."""
    h = ripples(rippled)[0]
    grid = np.arange(10.0, 100.0, 0.1)
    orders, multiples = np.tile(grid, 3), np.repeat([1, 2, 3], len(grid))
    weights = {(48.8, 1): 9.0, (24.4, 2): 9.5, (30.0, 1): 1.0}
    log_odds = np.full(len(orders), -30.0)
    for (order, m), odds in weights.items():
        log_odds[np.argmin(np.abs(orders - order) + 100 * (multiples != m))] = log(odds)
    none = np.zeros(0)
    posterior = OrderPosterior(
        h, orders, multiples, log_odds, 0.0, log_odds, 0.2, None, none, (0.0, 0.0)
    )  # type: ignore[arg-type]
    assert posterior.best == (pytest.approx(24.4), 2)
    assert posterior.likeliest_line == (pytest.approx(48.8), 1)
    assert posterior.probability(48.8) == pytest.approx(18.5 / 20.5, rel=1e-6)
    assert posterior.probability(24.4) == pytest.approx(9.5 / 20.5, rel=1e-6)
