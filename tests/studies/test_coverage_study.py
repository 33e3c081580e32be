"""The coverage study: its draws are what it says, and its estimate is the one `identify` makes."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "coverage"
sys.path.insert(0, str(FOLDER))

import scenarios
from support.study_scripts import study_of

from elastocal.cell import read_cell
from elastocal.identification.identify import identify
from elastocal.identification.start import Options
from elastocal.measurements import read_measurements
from elastocal.model.manipulator import Model
from elastocal.simulation import LOAD_N, expand_plan, published_compliances, simulate, values_from

study = study_of(FOLDER)
NAMES = {s.key: s for s in scenarios.SCENARIOS}


def test_the_study_estimates_what_the_tool_does():
    """The study works on the model linearised at the truth; the same campaign through `identify`
    gives the same estimates and intervals within a small part of a standard deviation."""
    demo = Path(str(files("elastocal.demo")))
    cell = read_cell(demo / "cell.toml")
    model = Model(cell)
    setting = scenarios.Setting(NAMES["table1_6_effect"])
    e, _ = setting.draw(0)
    rows = expand_plan(
        read_measurements(demo / "plan.csv", joint_kinds=model.chain.kinds, observe="plan"),
        tuple(cell.tool.markers), 6, np.array(LOAD_N),
    )  # fmt: skip
    truth = values_from(model, published_compliances(demo)[0])
    table = simulate(model, rows, truth, 0, noise=False)
    loaded = np.any(table.force != 0, axis=1)
    position = table.position.copy()
    position[loaded] += e.reshape(-1, 3)
    result = identify(model, replace(table, position=position), Options())
    readings = setting.readings(e)
    # The tool knows the tracker of the cell, which stands elsewhere than the study's.
    noise = study.settle(replace(readings, sight=None, reach=None))[0]
    std = noise.covariance.std
    for k, name in enumerate(setting.names):
        estimate = result[name]
        assert abs(estimate.value * 1e6 - setting.truth[k] - noise.x[k]) < 0.05 * std[k]
        assert estimate.std * 1e6 == pytest.approx(std[k], rel=0.02)
