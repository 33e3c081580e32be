"""Verdicts on small tables whose answer is known: no more is claimed than they carry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import elastocal as ec
from elastocal import Diagnosis

CASES = Path(__file__).parents[1] / "cases"


@cache
def diagnosed(case: str, **options: Any) -> Diagnosis:
    return ec.diagnose(CASES / case / "cell.toml", CASES / case / "train.csv", **options)


def test_an_effect_that_is_taken_out_is_named_by_no_engine() -> None:
    """The sum of all causes had it still; what is left is no noise then."""
    why = diagnosed("without_ignored", without="gravity_sag")
    named = {e.effect for e in (*why.effects, *why.slight)} | {c.effect for c in why.candidates}
    assert "gravity_sag" not in named
    assert why.verdict == "unknown_effect"
    assert why.gap.unexplained > 1e-3 > 3 * why.gap.noise_floor
    assert diagnosed("without_ignored").effects[0].effect == "gravity_sag"


def test_noise_of_poses_is_nothing() -> None:
    why = diagnosed("pose_noise_claimed")
    assert why.verdict == "nothing_significant" and not why.effects
    assert why.probability_nothing > max(c.probability for c in why.candidates)


def test_a_gap_of_twelve_times_the_noise_is_not_nothing() -> None:
    """A joint jumped, and nobody wrote down when anything was measured."""
    why = diagnosed("jump_untimed")
    assert why.verdict not in ("nothing_significant", "explained") or why.effects
    assert why.probability_nothing < 0.02


@pytest.mark.parametrize("case", ["without_ignored", "jump_untimed"])
def test_what_is_left_is_unexplained_or_noise(case: str) -> None:
    """Held-out errors before and after, the noise and what is unexplained add up."""
    gap = diagnosed(case, without=("gravity_sag",) if case == "without_ignored" else ()).gap
    left = (gap.explained**2 - gap.noise_floor**2) ** 0.5
    assert 0.5 * left < gap.unexplained < 1.05 * left


def test_sag_seen_by_a_camera_whose_y_points_down() -> None:
    """Weights act along −z of the readings' frame; the base says that −y is up."""
    case = CASES / "without_ignored"
    table = ec.Model(case / "cell.toml").read(case / "train.csv")
    camera = replace(table, position=table.position[:, [0, 2, 1]] * [1, -1, 1])
    why = ec.diagnose(case / "cell.toml", camera)
    assert why.verdict == "unknown_effect"
    (text,) = (w for w in why.warnings if "−y" in w)
    assert "−y points up" in text and "gravity_sag:joint2" in text
    fit = ec.identify(case / "cell.toml", replace(camera, force=camera.force + [0, 0, -50.0]))
    assert any("−y" in text for text in fit.warnings)
