"""Findings: each judgement made once, with one threshold wherever it is told."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.calibration import GEOMETRY, campaign

from elastocal.cell_tables import CartesianNoise, Tracker
from elastocal.diagnosis import diagnosis as diagnosis_result
from elastocal.identification import findings as module
from elastocal.identification.findings import judged, warning_sentences
from elastocal.identification.identify import identify
from elastocal.identification.noise_summary import LackOfFit

SIGMA = 5e-5
PAGE = Path(__file__).parents[2] / "docs" / "file-formats.md"


@pytest.fixture(scope="module")
def result():
    """A clean, adequate identification with its noise stated: it has no warning."""
    tracker = Tracker(noise=CartesianNoise(np.full(3, SIGMA)))
    found = identify(*campaign(GEOMETRY, 40, tracker=tracker)[:2])
    assert found.warnings == ()
    return found


def with_noise(result, **changed):
    return judged(replace(result, noise=replace(result.noise, **changed)))


def test_trust_comes_first_and_is_as_severe_as_the_worst(result):
    assert result.findings[0].kind == "trust" and result.findings[0].severity == "good"
    careful = with_noise(result, ratio_to_stated=3.0)
    assert careful.findings[0].severity == "care"
    assert careful.findings[0].numbers["because"] == ("residual_above_stated_noise",)
    lost = replace(careful, converged=False, reason="100 steps")
    assert judged(lost).findings[0].numbers["because"] == ("not_converged",)
    assert judged(lost).findings[0].severity == "poor"


@pytest.mark.parametrize("above", [False, True])
def test_residual_and_stated_noise_have_one_threshold(result, above):
    """Finding, doubt and warning begin at the same ratio, the end of what chance allows."""
    limit = result.finding("residual_agrees_with_stated_noise").number("by_chance_to")
    found = with_noise(result, ratio_to_stated=limit * (1 + (1e-6 if above else -1e-6)))
    assert (found.finding("residual_above_stated_noise") is not None) == above
    assert (found.findings[0].severity == "care") == above
    assert any("times the stated noise" in w for w in warning_sentences(found)) == above


@pytest.mark.parametrize("above", [False, True])
def test_lack_of_fit_has_one_threshold(result, above):
    p = module.LACK_OF_FIT * (1 - 1e-6 if above else 1 + 1e-6)
    found = with_noise(result, kind="axis", lack_of_fit=LackOfFit(2.0, p, 30, 200))
    assert (found.finding("lack_of_fit") is not None) == above
    assert (found.finding("repeats_agree") is None) == above
    assert any("scatter more than their repeats" in w for w in warning_sentences(found)) == above


def test_every_kind_is_on_the_page():
    text = PAGE.read_text(encoding="utf-8")
    kinds, makers = set(), {"Finding", "_good", "_note", "_care", "_poor"}
    for source in (module, diagnosis_result):
        for node in ast.walk(ast.parse(Path(source.__file__).read_text(encoding="utf-8"))):
            given = []
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in makers:
                given = node.args[:1]
            elif isinstance(node, ast.Assign) and "kind" in ast.unparse(node.targets[0]):
                given = [part for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
            kinds |= {k.value for k in given if isinstance(k, ast.Constant) and k.value}
    assert len(kinds) > 20
    assert not {kind for kind in kinds if f"`{kind}`" not in text}
