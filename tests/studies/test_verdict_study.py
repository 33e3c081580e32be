"""The study of the verdict: a campaign follows from its number, and the verdict keeps its word."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import sys
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "verdict"
sys.path.insert(0, str(FOLDER))

from support.study_scripts import study_of

study = study_of(FOLDER)


def test_a_trusted_campaign_is_as_good_as_said():
    row = study.run({"number": 0}, np.random.default_rng(0))
    assert row["tone"] == "good" and not row["missing"]
    assert row["true_um"] < study.ALLOWED * row["at_um"]
    assert row == study.run({"number": 0}, np.random.default_rng(1))


def test_where_screening_leaves_too_little_all_readings_are_judged():
    """Six poses of a seven-axis arm; without those that stand out, 36 equations are dependent."""
    row = study.run({"number": 16}, np.random.default_rng(0))
    assert not row["refused"] and row["tone"] == "care"


def test_what_has_too_few_readings_is_refused_or_not_trusted():
    assert study.run({"number": 3}, np.random.default_rng(0))["refused"]
    row = study.run({"number": 4}, np.random.default_rng(0))
    assert row["tone"] == "care" and "few_configurations" in row["missing"]
    assert row["true_um"] < row["heldout_um"] < 2 * row["true_um"]
