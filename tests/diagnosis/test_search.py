"""Forward selection under fitted noise: the planted set, no more, at the stated level."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis import (
    DiagnosisData,
    Flips,
    ForwardSelection,
    Hypothesis,
    Item,
    NoiseValues,
    SelectedEffects,
    Slot,
    base_score,
    covariance,
    diagnosis_data_of,
    direct,
    fit_baseline,
    fit_set,
    generic_blocks,
    log_prior_odds,
    packed_columns,
    possible,
    project,
    scan,
)
from elastocal.diagnosis.diagnose import chance_of_noise
from elastocal.diagnosis.diagnosis import SMALLEST_P
from elastocal.diagnosis.effect_search import FLIPS

TRIED = ("gear_eccentricity", "encoder_scale", "encoder_jump", "marker_slip", "hysteresis")
NOISE = NoiseValues(1.0, np.full(6, 3e-6), np.full(6, 0.2))


@lru_cache
def empty() -> DiagnosisData:
    """A data with five effects to try; residuals are put in by `noisy`."""
    model, table = campaign(n=24)
    hypotheses = [h for h in possible(model, table)[0] if h.name in TRIED]
    return diagnosis_data_of(fit_baseline(model, table), hypotheses)


def item(name: str, where: str, settings: tuple[float, ...] = ()) -> Item:
    h = next(h for h in empty().hypotheses if (h.name, h.where) == (name, where))
    return Item(h, np.array(settings), 0.0)


def noisy(seed: int, *planted: tuple[Item, tuple[float, ...]]) -> DiagnosisData:
    """Noise of exactly the modelled kind, and items at sizes in units of their typical ones."""
    dataset = empty()
    V = covariance(dataset.data, NOISE)
    z = np.random.default_rng(seed).normal(size=(*V.shape[:2], 1))
    r = (np.linalg.cholesky(V) @ z)[..., 0]
    for what, size in planted:
        r = r + packed_columns(dataset, what) @ np.array(size)
    return replace(dataset, data=replace(dataset.data, r=dataset.data.masked(r)))


def run(dataset: DiagnosisData, level: float = 0.05, blocks: bool = False) -> SelectedEffects:
    generic = generic_blocks(dataset) if blocks else []
    return ForwardSelection(dataset, generic, NOISE, level, 0).run()


def keys(found: SelectedEffects) -> set[tuple[str, str]]:
    return {
        (i.what.name, i.what.where) for i in found.chosen.items if isinstance(i.what, Hypothesis)
    }


SLIP = ("marker_slip", "marker:M1", (645.0,))
BEND = ("gear_eccentricity", "joint3", ())


def test_what_was_planted_is_chosen_with_its_time() -> None:
    found = run(noisy(1, (item(*SLIP), (1.0, -0.7, 0.4))))
    assert keys(found) == {SLIP[:2]}
    assert found.chosen.items[0].settings == pytest.approx(645.0, abs=16)
    assert len(found.slots) == len(found.p_values) == 1 and found.p_values[0] == SMALLEST_P


def test_three_effects_are_chosen_and_no_fourth() -> None:
    planted = [(SLIP, (1.0, -0.7, 0.4)), (BEND, (1.2, -1.0)), (("encoder_scale", "joint5"), (1.5,))]
    found = run(noisy(2, *[(item(*what), size) for what, size in planted]), blocks=True)
    assert keys(found) == {what[:2] for what, _ in planted}
    assert not found.chosen.unknown and len(found.slots) == 3


@pytest.mark.parametrize("blocks", [False, True])
def test_noise_alone_is_left_alone(blocks: bool) -> None:
    found = run(noisy(3), blocks=blocks)
    assert found.chosen.items == () and len(found.slots) == 1
    assert found.slots[0].probabilities()[1] > 0.5


@pytest.mark.long
def test_false_alarms_keep_to_the_level() -> None:
    """Of 60 at 5 %, more than eight come up once in a hundred times."""
    assert sum(bool(run(noisy(s)).chosen.items) for s in range(500, 560)) <= 8


def test_a_level_below_what_the_tail_of_the_flips_resolves_claims_nothing() -> None:
    dataset = noisy(1, (item(*SLIP), (1.0, -0.7, 0.4)))
    assert run(dataset, level=SMALLEST_P / 2).chosen.items == ()


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_a_fitted_set_and_a_scored_group_have_the_same_evidence(scale: float) -> None:
    """Columns inside the model at precision 1/s², or outside it under a prior of size s."""
    dataset = noisy(4, (item(*BEND), (0.3, 0.2)))
    C = packed_columns(dataset, item(*BEND))
    at = project(dataset.data, NOISE)
    inside = project(dataset.data.with_columns(C, np.full(2, scale**-2)), NOISE).marginal
    outside = direct(C, at).evidence(np.array([scale]))[0]
    assert inside - at.marginal == pytest.approx(outside, abs=1e-4)


def test_scores_of_a_scan_count_from_the_set_under_its_noise() -> None:
    dataset = noisy(5)
    nothing = fit_set(dataset, ())
    prior = log_prior_odds(dataset.hypotheses, [])
    observed = scan(dataset, [], prior, nothing.data, nothing.noise)
    assert base_score(dataset, nothing, observed) == pytest.approx(nothing.score, abs=1e-6)
    worse = scan(dataset, [], prior, nothing.data, NOISE)
    assert base_score(dataset, nothing, worse) < nothing.score + 0.5


def test_a_set_is_scanned_once_under_one_noise() -> None:
    dataset = noisy(5)
    search, nothing = ForwardSelection(dataset, [], NOISE, 0.05, 0), fit_set(dataset, ())
    plain = search._scan(nothing, NOISE)
    assert search._scan(nothing, NOISE) is plain and len(plain.flipped) == 0
    flipped = search._scan(nothing, NOISE, nothing)
    assert len(flipped.flipped) == FLIPS
    assert [s.evidence for s in plain.scored] == [s.evidence for s in flipped.scored]
    assert search._scan(nothing) is not plain
    other = fit_set(dataset, (item(*BEND),), NOISE)
    assert search._scan(other, NOISE).odds != plain.odds


def test_the_odds_of_all_are_the_prior_mean_of_each() -> None:
    dataset = noisy(6)
    blocks = generic_blocks(dataset)
    prior = log_prior_odds(dataset.hypotheses, blocks)
    signs = np.ones((1, 24))
    flips = Flips(signs, project(dataset.data, NOISE).scattered)
    observed = scan(dataset, blocks, prior, dataset.data, NOISE, flips)
    weights = np.exp(prior)
    each = np.exp([s.evidence for s in observed.scored])
    assert observed.odds == pytest.approx(np.log(weights @ each / weights.sum()))
    # Residuals are flipped at the noise's own size, a little above what a fit leaves.
    assert observed.flipped[0] == pytest.approx(observed.odds, abs=0.5)


def test_priors_share_out_what_is_not_nothing() -> None:
    """Even odds; a twentieth for the unknown; effects alike, whatever their number of places."""
    dataset = empty()
    prior = np.exp(log_prior_odds(dataset.hypotheses, generic_blocks(dataset)))
    assert prior.sum() == pytest.approx(1.0)
    assert prior[len(dataset.hypotheses) :].sum() == pytest.approx(0.05)
    each = dict.fromkeys(TRIED, 0.0)
    for h, share in zip(dataset.hypotheses, prior, strict=False):
        each[h.name] += share
    assert list(each.values()) == pytest.approx([0.95 / len(TRIED)] * len(TRIED))


def test_a_sum_has_a_p_of_its_own() -> None:
    """The forward search may have found nothing where many causes explain the gap together."""
    slot = Slot((item(*BEND),), np.array([-1.0]))
    scanned = SimpleNamespace(flipped=np.zeros(FLIPS), odds=-1.0)
    found = SelectedEffects(empty(), None, (slot,), (), None, scanned, scanned)  # type: ignore
    p, nothing = chance_of_noise(found, 0.0)
    assert p == 1.0 and nothing == pytest.approx(1 / (1 + np.exp(-1.0)))
    p, nothing = chance_of_noise(found, 5.0)
    assert (p, nothing) == pytest.approx((np.exp(-5.0), 1 / (1 + np.exp(5.0))))
    assert chance_of_noise(found, 50.0)[0] == SMALLEST_P


def test_a_slots_probabilities_and_nothings_sum_to_one() -> None:
    items = (item(*BEND), item(*SLIP))
    slot = Slot(items, np.array([900.0, 898.0]))
    each, nothing = slot.probabilities()
    assert each.sum() + nothing == pytest.approx(1.0)
    assert each[0] / each[1] == pytest.approx(np.exp(2.0)) and nothing < 1e-300
    best = slot.best_of(Slot(items[::1], np.array([901.0, 0.0])))
    np.testing.assert_array_equal(best.scores, [901.0, 898.0])
