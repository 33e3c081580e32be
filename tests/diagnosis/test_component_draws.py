"""Draws of a sum's coefficients: right in calibration, and about what looks alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.diagnosis_data import campaign, random_data

from elastocal.diagnosis import Component, NoiseValues, NoisyData, Sizes, fit_sum, posed
from elastocal.diagnosis.component_draws import SPREADS, Unseen, drawn
from elastocal.diagnosis.component_search import size_of_fellows
from elastocal.diagnosis.components import PRESENT, SPREAD
from elastocal.diagnosis.hypotheses import Hypothesis, possible
from elastocal.diagnosis.noise_floor import Weighted
from elastocal.model.arm import ParameterSpec
from elastocal.model.effects.base import Effect
from elastocal.model.effects.gears import EncoderScale, GearEccentricity, GearRipple
from elastocal.model.effects.gravity_sag import LinkWeights

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


def test_where_something_is_the_draws_hold_it(any_hypothesis: Hypothesis) -> None:
    """The same of what is there: neither more often than 90 % nor less."""
    data, rng, held = unit_data(), np.random.default_rng(2), []
    columns = 0.3 * rng.normal(size=(4, *data.r.shape, 2))
    components = [of_kind(k, c, any_hypothesis) for k, c in enumerate(columns)]
    for seed in range(25):
        spread = rng.choice(SPREADS)
        common = 1.0 + 0.1 * rng.normal()
        w = np.exp(common + spread * rng.normal(size=4))[:, None] * rng.normal(size=(4, 2))
        r = np.einsum("kcmi,ki->cm", columns, w)
        draws = draws_of(replace(data, r=r), components, np.full(4, common), seed)
        low, high = np.quantile(draws, [0.05, 0.95], axis=1)
        held += ((low <= w.ravel()) & (w.ravel() <= high)).tolist()
    assert abs(np.mean(held) - 0.9) < 4 * np.sqrt(0.09 / len(held)) + 0.01


def test_what_looks_like_something_else_is_as_its_fellows_are(any_hypothesis: Hypothesis) -> None:
    """Six places where a kind does 1, a seventh that looks like another cause that does 10: that
    half of this is the seventh's is believed less than where the six differ a hundredfold."""
    data, rng, beyond = unit_data(), np.random.default_rng(3), []
    columns = rng.normal(size=(7, *data.r.shape, 4))
    for sizes in (np.ones(6), 10.0 ** np.linspace(-1, 1, 6)):
        w = sizes[:, None] * rng.choice([-1.0, 1.0], size=(6, 4))
        r = np.einsum("kcmi,ki->cm", columns[:6], w) + columns[6] @ np.full(4, 10.0)
        kind = [of_kind(k, c, any_hypothesis) for k, c in enumerate(columns)]
        other = replace(of_kind(1, columns[6], any_hypothesis, LinkWeights), given=True)
        draws = draws_of(replace(data, r=r), [*kind, other], np.zeros(8), 3)
        beyond.append((np.abs(draws[24:28]).mean(axis=0) > 5.0).mean())
    assert beyond[0] < 0.1 < beyond[1]


def test_each_moment_has_a_size_of_its_own(any_hypothesis: Hypothesis) -> None:
    """One large moment among small ones is known no worse than by itself."""
    data, rng = unit_data(), np.random.default_rng(4)
    columns = rng.normal(size=(*data.r.shape, 8)) * np.append(0.2, np.ones(7))
    w = np.append(20.0, 0.05 * rng.normal(size=7))
    weights = replace(of_kind(1, columns, any_hypothesis, LinkWeights), given=True)
    log_size = 0.5 * np.log(np.mean(w**2))
    draws = draws_of(replace(data, r=columns @ w), [weights], np.array([log_size]), 4)
    assert draws[0].mean() == pytest.approx(20.0, abs=2 * draws[0].std())
    assert np.sqrt(np.mean(draws[1:] ** 2)) < 0.2


def test_moments_along_the_links_are_alike(any_hypothesis: Hypothesis) -> None:
    """Three moments of 100 among four of 0.1, and an eccentricity that looks like the third: it is
    believed to be the weight's where moments along the links are told from those across."""
    data, rng, taken = unit_data(), np.random.default_rng(6), []
    columns = rng.normal(size=(*data.r.shape, 7))
    w = np.append(np.full(3, 100.0), 0.1 * rng.normal(size=4))
    fellow, twin = (
        of_kind(k, c, any_hypothesis)
        for k, c in enumerate((rng.normal(size=data.r.shape)[..., None], columns[..., 2:3]))
    )
    r = columns @ w + 5 * fellow.columns[..., 0]
    for words in (["along"] * 3 + ["across"] * 4, [""] * 7):
        parameters = tuple(ParameterSpec(f"m{k}", "kg*m", 0.0, 1.0, shrunk=True, alike=word)
                           for k, word in enumerate(words))  # fmt: skip
        h = replace(any_hypothesis, parameters=parameters)
        weights = replace(of_kind(1, columns, h, LinkWeights), given=True)
        draws = draws_of(replace(data, r=r), [fellow, twin, weights], np.array([1.5, 3, 4]), 3)
        taken.append((np.abs(draws[1]) > 30).mean())
    assert taken[0] < taken[1]


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


def test_what_is_hidden_pays_for_being_there(any_hypothesis: Hypothesis) -> None:
    """Of two causes that are alike, the one in the sum does not lose what it does to the other
    because this one hides."""
    data, rng = unit_data(), np.random.default_rng(5)
    one, other = rng.normal(size=(2, *data.r.shape, 1))
    mine, twin = (of_kind(k, c, any_hypothesis) for k, c in enumerate((one, one + 0.3 * other)))
    r = rng.normal(size=data.r.shape) + 10 * one[..., 0]
    found = fit_sum(replace(data, r=r), [mine], QUIET, refit_noise=False)
    extra = np.full(1, np.exp(-2 * size_of_fellows(found, twin)))
    wide = found.data.with_columns(data.masked(twin.columns), extra)
    w = drawn(found, (twin,), Weighted.of(wide, found.noise), wide.precision, 200, rng).coefficients
    assert np.median(w[-2]) == pytest.approx(10.0, rel=0.05)
    assert (w[-1] == 0).mean() > 0.5


@pytest.mark.parametrize("fellows", [pytest.param((), marks=pytest.mark.long), (0.0, 0.3, -0.4)])
def test_lines_that_are_not_seen_are_drawn_as_they_are(
    any_hypothesis: Hypothesis, fellows: tuple[float, ...]
) -> None:
    """Another error of two joints at every configuration beside two columns and a component, and
    a third joint that has none: 90 % of the intervals hold them, and what they are together."""
    data, rng = unit_data(), np.random.default_rng(8)
    columns = rng.normal(size=(3, *data.r.shape))
    mine = of_kind(1, 0.3 * rng.normal(size=(*data.r.shape, 2)), any_hypothesis)
    mine = replace(mine, given=True)
    held, squares, none = [], [], []
    for seed in range(20):
        noise, errors = (rng.normal(size=shape) for shape in (data.r.shape, (3, len(data.r))))
        errors *= np.array([1.0, 1.4, 0.0])[:, None]
        r = noise + mine.columns @ np.ones(2) + np.einsum("ucm,uc->cm", columns, errors)
        found = fit_sum(replace(data, r=r), [mine], QUIET, refit_noise=False)
        at, unseen = Weighted.of(found.data, QUIET), Unseen(columns, fellows, 3 + len(fellows))
        draws = drawn(
            found, (), at, found.data.precision, 200, np.random.default_rng(seed), unseen
        ).unseen
        low, high = np.quantile(draws[:2], [0.05, 0.95], axis=-1)
        held += ((low <= errors[:2]) & (errors[:2] <= high)).ravel().tolist()
        low, high = np.quantile((draws[:2] ** 2).sum(axis=1), [0.05, 0.95], axis=-1)
        each = (errors[:2] ** 2).sum(axis=1)
        squares += ((low <= each) & (each <= high)).tolist()
        none.append(np.mean(draws[2] ** 2))
    assert abs(np.mean(held) - 0.9) < 0.04
    assert np.mean(squares) >= 0.8
    assert np.mean(none) < 0.05


def test_a_joint_without_lines_has_what_the_others_let_expect(any_hypothesis: Hypothesis) -> None:
    """Where the readings show nothing of it, and nothing where no other joint has any."""
    data, drawn_rms = unit_data(), []
    mine = of_kind(1, 0.3 * np.random.default_rng(9).normal(size=(*data.r.shape, 2)),
                   any_hypothesis)  # fmt: skip
    found = fit_sum(replace(data, r=mine.columns @ np.ones(2)), [mine], QUIET, refit_noise=False)
    for fellows in ((), (0.0,) * 5):
        unseen = Unseen(np.full((1, *data.r.shape), 1e-4), fellows, 6)
        draws = drawn(
            found, (), Weighted.of(found.data, QUIET), found.data.precision, 300,
            np.random.default_rng(0), unseen,
        ).unseen  # fmt: skip
        drawn_rms.append(np.sqrt((draws**2).mean(axis=(0, 1))))
    nothing, expected = drawn_rms
    assert (nothing == 0).mean() > 0.5
    assert (expected > 0).mean() > 0.7 and 0.5 < np.median(expected[expected > 0]) < 2.0
