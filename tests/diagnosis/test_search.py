"""Forward selection under fitted noise: the planted set, no more, at the stated level."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis import (
    DiagnosisData,
    ForwardSelection,
    Hypothesis,
    Item,
    NoiseValues,
    SelectedEffects,
    covariance,
    diagnosis_data_of,
    fit_baseline,
    generic_blocks,
    packed_columns,
    possible,
)

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
