"""What acts at many joints at once: the prior of kinds, kinds made whole, orders of lines; and how
fast the base drifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.diagnosis_data import campaign, random_data

from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.component_families import (
    drifts,
    line_families,
    sharpened,
    shorter,
    with_multiples,
)
from elastocal.diagnosis.component_search import (
    completed,
    with_expected_families,
    with_shorter_drifts,
)
from elastocal.diagnosis.components import (
    Component,
    fit_sum,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData
from elastocal.model.effects.gears import EncoderScale, GearEccentricity

QUIET = NoiseValues.usual(3).of_instrument()


def plain_data() -> NoisyData:
    """Two fitted columns under noise of unit variance, no residual yet."""
    data = random_data(5, p=2)
    unit = np.tile(np.eye(data.r.shape[1]), (len(data.r), 1, 1))
    return replace(data, left_out=data.left_out & False, covariance=unit, r=0 * data.r)


def fellow(k: int, columns: np.ndarray, effect: type = EncoderScale) -> Component:
    return Component("angle", effect(), f"joint{k + 1}", columns, fellows=6)


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
