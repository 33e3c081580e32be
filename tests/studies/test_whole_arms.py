"""Whole simulated arms: what is drawn, what an oracle can know of them, and how answers count."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "blind_diagnosis"
sys.path.insert(0, str(FOLDER))

from arm_data import ARMS
from whole_columns import components, moments
from whole_draw import WEIGHTS, draw_whole
from whole_oracle import Sights, oracle_errors
from world_files import write_world


@pytest.fixture(scope="module", params=ARMS)
def sights(request):
    return Sights.of(draw_whole((8, 1), "whole", 60, arm=request.param))


def rms(x):
    return float(np.sqrt(np.mean(x**2)))


def test_the_tool_is_told_neither_weights_nor_orders(tmp_path):
    world = draw_whole((8, 2), "whole", 8, approach=False)
    write_world(world, tmp_path / "v", tmp_path / "s")
    assert "mass" not in (tmp_path / "v" / "arm.urdf").read_text()
    cell = (tmp_path / "v" / "cell.toml").read_text()
    assert "link_gravity = false" in cell and "orders" not in cell
    header = (tmp_path / "v" / "data.csv").read_text().splitlines()[0]
    assert "time_min" in header and "approach" not in header
    assert np.all(np.diff(world.visits.time) > 0)
    came = np.sign(np.diff(world.visits.q, axis=0))
    moved = came.any(axis=1)
    assert np.array_equal(world.visits.approach[1:][moved], came[moved])


def test_the_arm_moves_as_the_columns_say(sights):
    """All effects together, by MuJoCo and to first order: within a hundredth."""
    world = sights.world
    whole, bare = (w.noise_free(world.visits) for w in (world, replace(world, effects=())))
    parts = [part[: sights.n] for part in components(world, sights.visits, sights.scene).values()]
    moved = (whole - bare).reshape(len(whole), -1)
    assert rms(moved - sum(parts)) < 0.01 * rms(moved)
    (heavy,) = (e for e in world.effects if e.name == WEIGHTS)
    load = sights.scene.carried + sights.scene.weighing @ moments(heavy)
    assert load == pytest.approx(sights.scene.load, abs=2e-3 * np.abs(load).max())


def test_the_oracle_errs_as_its_covariance_says():
    """Mean square of 5 arms, each with some hundred degrees of freedom of its own."""
    every = [oracle_errors(Sights.of(draw_whole((8, 7, k), "w", 40))) for k in range(5)]
    ratios = np.array([error / expected for error, expected in every])
    assert np.mean(ratios**2) == pytest.approx(1.0, abs=0.2)
