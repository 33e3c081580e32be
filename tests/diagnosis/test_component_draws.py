"""Draws of a sum's coefficients: right in calibration, and about what looks alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.diagnosis_data import campaign, random_data

from elastocal.diagnosis import Component, NoiseValues, NoisyData, Sizes, fit_sum, posed
from elastocal.diagnosis.component_draws import SPREADS, drawn
from elastocal.diagnosis.components import PRESENT, SPREAD
from elastocal.diagnosis.hypotheses import Hypothesis, possible
from elastocal.model.effects.base import Effect
from elastocal.model.effects.gears import EncoderScale, GearEccentricity, GearRipple

Array = np.ndarray
QUIET = NoiseValues.usual(3).of_instrument()


@pytest.fixture(scope="module")
def any_hypothesis() -> Hypothesis:
    """One that needs no search; what it says does not matter here."""
    return possible(*campaign(n=20))[0][0]


def unit_data() -> NoisyData:
    """Readings with a noise of one that are to come."""
    data = random_data(5, p=2)
    unit = np.tile(np.eye(data.r.shape[1]), (len(data.r), 1, 1))
    return replace(data, left_out=data.left_out & False, covariance=unit, r=0 * data.r)


def of_kind(
    k: int, columns: Array, h: Hypothesis, effect: type[Effect] = EncoderScale
) -> Component:
    if len(h.parameters) != columns.shape[2]:
        h = replace(h, parameters=h.parameters[:1] * columns.shape[2])
    return Component("angle", effect(), f"joint{k}", columns, hypothesis=h, fellows=4)


def draws_of(data: NoisyData, components: list[Component], log_sizes: Array, seed: int) -> Array:
    """Draws (Σ k, 200) of the components' coefficients, begun at these sizes."""
    data = replace(data, r=data.r + np.random.default_rng(seed).normal(size=data.r.shape))
    found = fit_sum(data, components[:1], QUIET, refit_noise=False)
    wide = posed(data, components, QUIET)
    at = Sizes(0.0, log_sizes, np.zeros(len(components)))
    whole = replace(found, components=wide.components, sizes=at, sums=wide)
    widths = [c.width for c in components]
    precision = np.concatenate([data.precision, np.exp(-2 * np.repeat(log_sizes, widths))])
    rng = np.random.default_rng(seed)
    return drawn(whole, (), wide.weighted, precision, 200, rng).coefficients[-sum(widths) :]


@pytest.mark.long
def test_what_is_drawn_from_the_prior_lies_where_draws_say(any_hypothesis: Hypothesis) -> None:
    """Kinds that are there or not, at some of four places, as alike as they happen to be: 90 % of
    the draws' intervals hold what is true, over all that the prior may bring."""
    data, rng, held = unit_data(), np.random.default_rng(1), []
    columns = 0.3 * rng.normal(size=(4, *data.r.shape, 2))
    components = [of_kind(k, c, any_hypothesis) for k, c in enumerate(columns)]
    for seed in range(25):
        spread = rng.choice(SPREADS)
        common = np.sqrt(SPREAD**2 - spread**2) * rng.normal()
        size = np.exp(common + spread * rng.normal(size=4))
        places = rng.permutation(4)[: rng.integers(1, 5)] if rng.random() < PRESENT else []
        w = np.where(np.isin(np.arange(4), places), size, 0.0)[:, None] * rng.normal(size=(4, 2))
        r = np.einsum("kcmi,ki->cm", columns, w)
        draws = draws_of(replace(data, r=r), components, np.zeros(4), seed)
        low, high = np.quantile(draws, [0.05, 0.95], axis=1)
        held.append((low <= w.ravel()) & (w.ravel() <= high))
    there = np.array(held)
    # Where nothing is and nothing is drawn, both are zero and the interval holds.
    assert there.mean() > 0.9


def test_sizes_are_drawn_with_the_coefficients(any_hypothesis: Hypothesis) -> None:
    """Of two causes that look alike either may be it; what one alone does is known as well as by
    the posterior at its size."""
    data, rng = unit_data(), np.random.default_rng(0)
    one, two = (rng.normal(size=(*data.r.shape, 1)) for _ in range(2))
    effects = (EncoderScale(), GearEccentricity(), GearRipple())
    alike, twin, alone = (
        Component("angle", e, "joint1", columns, hypothesis=any_hypothesis)
        for e, columns in zip(effects, (one, one, two), strict=True)
    )
    noise = rng.normal(size=data.r.shape)
    data = replace(data, r=noise + 30 * one[..., 0] + 4 * two[..., 0])
    found = fit_sum(data, [alike, alone], QUIET, refit_noise=False)
    wide = posed(data, [alike, alone, twin], found.noise)
    at = Sizes(0.0, np.array([3.0, 1.0, 0.0]), np.zeros(3))
    both = replace(found, components=wide.components, sizes=at, sums=wide)
    precision = np.concatenate([data.precision, np.exp(-2 * at.size)])
    w = drawn(both, (), wide.weighted, precision, 400, rng).coefficients
    one_of, other, twin_of = w[-3:]
    known = np.linalg.inv(wide.weighted.M + np.diag(precision))
    sd = np.sqrt(known[-2, -2])
    assert abs(other.mean() - (known @ wide.weighted.z)[-2]) < 4 * sd / 20
    assert other.std() == pytest.approx(sd, rel=0.15)
    np.testing.assert_allclose(one_of + twin_of, 30.0, atol=1.0)
    assert min((one_of > 25).mean(), (twin_of > 25).mean()) > 0.1
