"""One figure for the noise: what readings scatter by whatever the arm does, in both verbs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identification.test_far_values import CASES, THREE, cell, poses

import elastocal as ec

ONE = "M1 = [0.12, 0.02, 0.05]"
CORRECT = "Correct [tracker]"


def readings(folder, markers, repeats=1, true=40.0):
    path = cell(folder, "true", markers=markers, sigma=true)
    return ec.simulate(path, poses(50, 3), draw=0.3, seed=4, repeats=repeats)


def steps(fit: ec.Calibration) -> str:
    return " ".join(f.remedy for f in fit.findings)


@pytest.mark.parametrize(
    ("markers", "repeats"), [pytest.param(THREE, 1, marks=pytest.mark.long), (ONE, 3)]
)
def test_both_verbs_say_the_same_and_to_correct_what_is_stated(tmp_path, markers, repeats):
    """By markers of one pose, or by repeats; what is larger than stated is noise and no doubt."""
    table = readings(tmp_path, markers, repeats)
    path = cell(tmp_path, markers=markers, sigma=30)
    fit, found = ec.identify(path, table), ec.diagnose(path, table)
    assert fit.noise.ratio_to_stated == pytest.approx(4 / 3, rel=0.07)
    assert found.noise.ratio_to_stated == pytest.approx(fit.noise.ratio_to_stated, rel=0.02)
    assert fit.verdict.trusted and CORRECT in steps(fit)
    assert "scatter 1.3 times" in steps(fit)
    assert any("1.3 times as much" in w and "correct [tracker]" in w for w in found.warnings)


def test_an_effect_beside_noise_as_stated_is_no_noise(tmp_path):
    """As large an excess, which markers of one pose share."""
    table = readings(tmp_path, THREE, true=30.0)
    table = replace(table, position=table.position + 5e-5 * np.sin(3 * table.q[:, 1:4]))
    fit = ec.identify(cell(tmp_path, sigma=30), table)
    assert fit.noise.ratio_to_stated > 1.2 and not fit.verdict.trusted
    assert CORRECT not in steps(fit) and "diagnose" in steps(fit)


def test_the_guesses_of_a_first_cell_are_no_evidence():
    """Markers and a noise that init guessed: the readings tell the noise themselves."""
    folder = CASES / "init_markers"
    fit = ec.identify(folder / "cell.toml", folder / "train.csv")
    assert fit.verdict.trusted and "scatter 2 times" in steps(fit)
