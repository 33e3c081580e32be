"""Spectra over settings against the columns of each setting, formed one by one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis import (
    DiagnosisData,
    Flips,
    Grams,
    Hypothesis,
    NoiseValues,
    diagnosis_data_of,
    direct,
    fit_baseline,
    possible,
    project,
)
from elastocal.diagnosis import evidence as gram

NOISE = NoiseValues(1.0, np.full(6, 3e-6), np.full(6, 0.2))
TRIED = (
    ("gear_ripple", "joint5"), ("encoder_jump", "joint2"), ("frame_jump", "tracker"),
    ("base_drift", "base"), ("encoder_scale", "joint3"),
)  # fmt: skip


@lru_cache
def made() -> DiagnosisData:
    model, table = campaign(n=24)
    hypotheses = [h for h in possible(model, table)[0] if (h.name, h.where) in TRIED]
    return diagnosis_data_of(fit_baseline(model, table), hypotheses)


def unused() -> DiagnosisData:
    """The data without what it has kept."""
    known = made()
    return DiagnosisData(
        known.base, known.columns, known.hypotheses, known.data, known.fitted, known.load_point
    )  # fmt: skip


def hypothesis(name: str) -> Hypothesis:
    return next(h for h in made().hypotheses if h.name == name)


@pytest.mark.parametrize("held", [gram.HELD, 500])
@pytest.mark.parametrize("name", [name for name, _ in TRIED])
def test_every_setting_scores_as_the_columns_it_stands_for(
    name: str, held: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gram, "HELD", held)
    at = project(made().data, NOISE)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (5, len(made().blocks.member)))
    h = hypothesis(name)
    turned = Flips(signs, at.scattered)
    found = Grams(unused(), made().data, at, turned).of(h)
    values = made().grids[h.name, h.where].values
    assert len(found.lam) == len(values)
    flips = found.flipped(np.zeros((len(values), 1)))
    for k in range(0, len(values), max(len(values) // 7, 1)):
        expected = direct(made().data.masked(made().packed(h, values[k])), at, turned)
        np.testing.assert_allclose(found.evidence()[k], expected.evidence()[0], atol=1e-6)
        np.testing.assert_allclose(flips[k], expected.flipped(np.zeros((1, 1)))[0], atol=1e-6)


def test_what_follows_a_joint_angle_is_evaluated_once_for_a_configuration() -> None:
    """Its visits under all loads stand at the same angles, at different times."""
    known, visits = made(), made().present.shape[1]
    assert visits > 1
    for name, of_each in (("gear_ripple", 1), ("frame_jump", visits)):
        h = hypothesis(name)
        assert known.direction(h, known.grids[h.name, h.where].values[:3]).shape[1] == of_each


def test_nothing_hangs_on_what_is_kept() -> None:
    h = hypothesis("gear_ripple")
    settings = made().grids[h.name, h.where].values
    kept = made().direction(h, settings)
    assert made().direction(h, settings) is kept
    forgetful = unused()
    forgetful.kept.room = 0
    first = forgetful.direction(h, settings)
    assert forgetful.direction(h, settings) is not first
    np.testing.assert_array_equal(first, kept)
