"""Headline, default point and map speak of the same point, or say why not and what to state."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from identification.test_far_values import CASES

import elastocal as ec


@pytest.fixture(scope="module")
def fit() -> ec.Calibration:
    """Of the cell as init writes it: nobody said where the load point lies among the markers."""
    folder = CASES / "init_markers"
    return ec.identify(folder / "cell.toml", folder / "train.csv")


def test_the_headline_says_that_it_is_of_the_markers_and_what_to_state(fit):
    sentence = fit.to_json()["verdict"]["sentence"]
    assert "is known only to 2" in sentence
    assert "measure a marker there, or state `point` M1" in sentence
    own = ec.compensate(fit.arm, [1.0, 0.0, 0.6]).uncertainty
    assert fit.to_json()["load_point_um"] > 10 * fit.verdict.at * 1e6
    assert json.dumps(fit.to_json()["load_point_um"]) and own is not None


def test_the_map_is_of_the_marker_that_the_headline_speaks_of(fit, tmp_path: Path):
    page = tmp_path / "r.html"
    fit.report(page)
    assert "marker M1" in page.read_text(encoding="utf-8")


def test_without_a_load_point_there_is_nothing_to_say(fit):
    cell = replace(fit.model.cell, tool=replace(fit.model.cell.tool, load_point=0 * fit.x[:3]))
    bare = ec.identify(cell, CASES / "init_markers" / "train.csv")
    assert bare.load_point_error is None
    assert "load point" not in bare.to_json()["verdict"]["sentence"]
