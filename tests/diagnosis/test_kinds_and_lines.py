"""What acts at many joints at once: the prior of kinds, kinds made whole, orders of lines; and how
fast the base drifts."""

from __future__ import annotations

from dataclasses import replace
from math import comb, exp

import numpy as np
import pytest
from support.diagnosis_data import campaign, random_data

from elastocal.diagnosis import Component, NoiseValues, NoisyData, fit_baseline
from elastocal.diagnosis.component_families import (
    drifts,
    line_families,
    sharpened,
    shorter,
    whole_families,
    with_multiples,
)
from elastocal.diagnosis.component_search import (
    completed,
    hidden_fellows,
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
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible
from elastocal.model.effects.gears import EncoderScale, GearEccentricity

QUIET = NoiseValues.usual(3).of_instrument()


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


def test_many_of_a_kind_come_in_together_where_none_would_alone() -> None:
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
    np.testing.assert_allclose(hidden.columns, sixth.columns * size)


def test_orders_of_lines_are_found_beside_each_other() -> None:
    """And how well each is known is honest."""
    model, table = campaign("gear_ripple:joint5", n=60, sigma=2e-5)
    base = fit_baseline(model, table)
    hypotheses, _ = possible(model, table)
    dataset = diagnosis_data_of(base, hypotheses)
    start = fit_sum(dataset.data, [], dataset.noise)
    best = line_families(dataset, start)[0]
    assert best.where == "joint5" and best.gain > 10
    found = fit_sum(dataset.data, [best.component], start.noise)
    again = sharpened(dataset, found) or list(found.components)
    settings = dict(again[0].settings)
    order, sd = settings["order_1"], settings["order_sd_1"]
    assert sd < 0.2 and abs(order - 81.3 / round(81.3 / order)) < 4 * sd
    one = with_multiples(dataset, again[0]).get(1, again[0])
    ((family, whole),) = whole_families(dataset, [one])
    orders = [value for key, value in whole.settings if not key.startswith("order_sd")]
    assert family is one and orders == pytest.approx([order, 2 * order, 3 * order])
    assert not whole_families(dataset, [whole])


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
