"""Markers whose names are exchanged: told with rows and remedy, and seldom where they are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import elastocal as ec
from elastocal.cell_tables import CartesianNoise, ModelSpec
from elastocal.identification.faulty_readings import exchanged

DEMO = Path(ec.__file__).parent / "demo"
MARKERS = {"M1": [0.25, 0.0, 0.05], "M2": [-0.12, 0.22, 0.10], "M3": [0.0, -0.2, 0.08]}
EFFECTS = ["base_frame", "joint_offset", "marker_position"]


@pytest.fixture(scope="module")
def model() -> ec.Model:
    return ec.Model(ec.Cell(
        name="three markers", robot=ec.Robot.from_urdf(DEMO / "kr270_2.urdf", flange="flange"),
        tool=ec.Tool(markers=MARKERS), tracker=ec.Tracker(noise=CartesianNoise([1e-5] * 3)),
        model=ModelSpec(effects=EFFECTS),
    ))  # fmt: skip


def campaign(model: ec.Model, seed: int = 0, poses: int = 16) -> ec.Measurements:
    lower, upper = [-1.2, -2, 0.3, -1.2, -1.2, -1.2], [1.2, -0.4, 2, 1.2, 1.2, 1.2]
    q = np.random.default_rng(seed).uniform(lower, upper, (poses, 6))
    return ec.simulate(model, q, draw=1.0, seed=seed)


def renamed(table: ec.Measurements, rows: np.ndarray, order: list[int]) -> ec.Measurements:
    return replace(table, marker=np.where(rows, np.array(order)[table.marker], table.marker))


@pytest.mark.parametrize(("first", "order"), [(1, [1, 0, 2]), (12, [1, 2, 0])])
def test_the_rows_are_told_from_whichever_pose_names_are_exchanged(model, first, order):
    table = campaign(model)
    rows, _, words = exchanged(model, renamed(table, table.configuration >= first, order))
    moved = (table.configuration >= first) & (np.array(order)[table.marker] != table.marker)
    assert np.array_equal(rows, np.flatnonzero(moved))
    assert f"{moved.sum()} rows (lines {table.row[moved][0]}–{table.row[moved][-1]}" in words


def test_names_exchanged_everywhere_are_told_by_the_places_of_the_cell(model):
    table = campaign(model)
    fit = ec.identify(model, renamed(table, np.ones(len(table), dtype=bool), [1, 0, 2]))
    found = fit.finding("exchanged_markers")
    assert found.severity == fit.verdict.tone == "care"
    assert found.numbers["markers"] == ("M1", "M2") and found.numbers["rows"] == 32
    told = " ".join(str(fit).split())
    assert told.count("exchanged in all rows of the table, or in the cell") == 1
    assert "with care: the names of markers M1, M2 are exchanged" in told


def test_of_one_pose_it_is_a_note_and_of_many_the_calibration_is_refused(model):
    table = campaign(model)
    one = renamed(table, table.configuration == 4, [1, 0, 2])
    found = ec.identify(model, one).finding("exchanged_markers")
    assert found.severity == "note" and "configuration 5)" in found.remedy
    many = renamed(table, table.configuration >= 9, [1, 0, 2])
    with pytest.raises(ec.InsufficientDataError, match="markers M1, M2 are exchanged in 14 rows"):
        ec.identify(model, many)


def test_nothing_is_told_of_clean_tables(model):
    """With markers that are guessed to 60 mm, or not at all, a tenth of the readings wrong, and
    the sign of a joint; at most as many as 1 % allow for."""
    rng, told = np.random.default_rng(0), 0
    for seed in range(6):
        table = campaign(model, seed)
        off = np.where(rng.random((len(table), 1)) < 0.1, rng.normal(0, 0.3, (len(table), 3)), 0)
        guesses = {n: np.array(p) + rng.normal(0, 0.06, 3) for n, p in MARKERS.items()}
        for markers, readings in (
            (guesses, table), ({name: [0.0, 0.0, 0.0] for name in MARKERS}, table),
            (MARKERS, replace(table, position=table.position + off)),
            (MARKERS, replace(few := campaign(model, seed, 9), q=few.q * [1, 1, 1, 1, 1, -1])),
        ):  # fmt: skip
            tool = ec.Tool(markers=markers)
            told += exchanged(ec.Model(replace(model.cell, tool=tool)), readings) is not None
    assert told == 0
