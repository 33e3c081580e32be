"""Faulty readings are found, and only those; what an arm does is not taken for a fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import kr270_chain, random_poses, table_of
from support.diagnosis_data import SIGMA, campaign, cell, measured

import elastocal as ec
from elastocal import Measurements
from elastocal.cell_tables import Nominal
from elastocal.model.manipulator import Model

RIGID = ("base_frame", "joint_offset", "marker_position")


def with_faults(table: Measurements, rows: np.ndarray) -> Measurements:
    error = np.random.default_rng(4).normal(size=(len(rows), 3))
    position = table.position.copy()
    position[rows] += 1e-3 * error / np.linalg.norm(error, axis=1, keepdims=True)
    return replace(table, position=position)


def lines(why: ec.Diagnosis) -> list[int]:
    return sorted(f.line for f in why.noise.faulty)


def test_readings_that_are_a_millimetre_off_are_found_and_no_other() -> None:
    """Even all of a visit; one whose markers moved together has none.  Metres off go first."""
    model, table = campaign(n=30)
    rows = np.array([31, 60, 61, 62, 88, 147])
    read = with_faults(table, rows)
    together = (table.configuration == 7) & (table.force[:, 2] == 0)
    position = read.position + together[:, None] * np.array([6e-4, -6e-4, 6e-4])
    position[[10, 100, 101]] = 0.0
    why = ec.diagnose(model, replace(read, position=position))
    assert lines(why) == sorted(table.row[rows])
    assert any("3 readings left out" in t and "lines 12, 102–103" in t for t in why.warnings)
    for f in why.noise.faulty:
        (k,) = np.flatnonzero(table.row == f.line)
        assert f.error == pytest.approx(1e-3, rel=0.1)
        assert f.sigmas == pytest.approx(f.error / SIGMA / why.noise.stated_factor, rel=0.01)
        assert f.configuration == table.configuration_labels[table.configuration[k]]
        assert f.marker == table.marker_names[table.marker[k]]


def test_a_visit_that_its_repeats_contradict_is_faulty() -> None:
    model, table = campaign()
    table = table.take(table.configuration < 16)
    rows = np.concatenate([np.arange(len(table))] * 3)
    repeat = np.repeat(np.arange(3), len(table))
    again = replace(table.take(rows), row=np.arange(len(rows)) + 2, repeat=repeat,
                    time=table.time[rows] + 3000.0 * repeat)  # fmt: skip
    noise = SIGMA * np.random.default_rng(5).normal(size=again.position.shape)
    bad = (again.configuration == 7) & (again.force[:, 2] == 0) & (repeat == 1)
    position = again.position + noise + bad[:, None] * np.array([6e-4, -6e-4, 6e-4])
    why = ec.diagnose(model, replace(again, position=position))
    assert lines(why) == sorted(again.row[bad])


@pytest.mark.parametrize("kind", ["lag", pytest.param("curves", marks=pytest.mark.long)])
def test_markers_tell_the_faulty_readings_of_an_arm_unlike_its_model(kind: str) -> None:
    """Every move leaves it short by a different part, or all its joints have curves of errors."""
    chain, plain, n = kr270_chain(), cell(RIGID, link_gravity=False, nominal=Nominal()), 30
    q = random_poses(chain, n, 1)
    table = table_of(q, np.zeros(3), both=False)
    off = table.q.copy()
    if kind == "lag":
        moved = np.diff(q, axis=0, prepend=q[:1])
        part = moved / np.maximum(np.abs(moved).max(axis=1, keepdims=True), 1e-9)
        random = np.random.default_rng(3).lognormal(0, 1, (n, 1))
        off += (2e-4 * part * random)[table.configuration]
    else:
        off += 2e-4 * np.sin(7.3 * table.q + np.arange(6))
    read = replace(measured(chain, plain, [], replace(table, q=off), 1), q=table.q)
    rows = np.array([17, 62, 80])
    why = ec.diagnose(Model.assembled(chain, plain), with_faults(read, rows))
    assert lines(why) == sorted(read.row[rows])


@pytest.mark.long
def test_heavy_tails_are_not_faults() -> None:
    """t with 4 degrees of freedom, of the stated size: all but a handful stay."""
    model, table = campaign(n=60)
    shake = np.random.default_rng(3).standard_t(4, size=table.position.shape) / np.sqrt(2)
    table = replace(table, position=table.position + SIGMA * shake)
    assert len(lines(ec.diagnose(model, table))) <= 0.02 * len(table)
