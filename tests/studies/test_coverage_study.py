"""The coverage study: its draws are what it says, and its estimate is the one `identify` makes."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "coverage"
sys.path.insert(0, str(FOLDER))

import scenarios
import study

from elastocal.cell_reader import read_cell
from elastocal.demo import LOAD_N, published_compliances
from elastocal.identification.identify import Options, identify
from elastocal.manipulator.model import Model
from elastocal.measurement_reader import read_plan
from elastocal.simulation.simulate import expand_plan, simulate, values_from

NAMES = {s.key: s for s in scenarios.SCENARIOS}


@pytest.mark.parametrize("key", ["table1_6_effect", "polar_3"])
def test_draws_have_the_covariance_that_the_oracle_knows(key):
    """Mean of dᵀ Σ⁻¹ d over 40 draws of n rows: n ± 5 √(2 n / 40)."""
    setting = scenarios.Setting(NAMES[key])
    inverse = np.linalg.inv(setting.covariance)
    squared = [e @ inverse @ e for e in (setting.draw(k)[0] for k in range(40))]
    n = len(setting.covariance)
    assert abs(np.mean(squared) - n) < 5 * np.sqrt(2 * n / 40)


def test_outliers_are_of_the_size_and_share_stated():
    setting = scenarios.Setting(NAMES["table1_6_outliers"])
    shares, lengths = [], []
    for k in range(20):
        e, clean = setting.draw(k)
        shares.append((~clean).mean())
        lengths += np.linalg.norm(e.reshape(-1, 3)[~clean], axis=1).tolist()
    assert 0.04 < np.mean(shares) < 0.06
    assert min(lengths) > 0.3e-3 and max(lengths) < 11e-3 and 4e-3 < np.mean(lengths) < 7e-3


def test_the_study_estimates_what_the_tool_does():
    """The study works on the model linearised at the truth; the same campaign through `identify`
    gives the same estimates and intervals within a small part of a standard deviation."""
    demo = scenarios.DEMO
    cell = read_cell(demo / "cell.toml")
    model = Model.from_cell(cell)
    setting = scenarios.Setting(NAMES["table1_6_effect"])
    e, _ = setting.draw(0)
    rows = expand_plan(
        read_plan(demo / "plan.csv", joint_kinds=model.chain.kinds),
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
    noise = study.settle(replace(readings, sight=None, reach=None)).noise
    std = noise.covariance.std
    for k, name in enumerate(setting.names):
        estimate = result.estimate(name)
        assert abs(estimate.value * 1e6 - setting.truth[k] - noise.x[k]) < 0.05 * std[k]
        assert estimate.std * 1e6 == pytest.approx(std[k], rel=0.02)


def test_a_study_is_resumed_where_it_stopped(tmp_path):
    """The second run reads what the first has written and adds the missing chunk only."""
    scenario = NAMES["polar_3"]
    study.run_chunk(scenario, 0, tmp_path)
    path = tmp_path / "polar_3_000000.npy"
    first = np.load(path)
    assert first.shape == (study.CHUNK, len(study.METHODS), 9, 3)
    study.run_chunk(scenario, 0, tmp_path)
    np.testing.assert_array_equal(np.load(path), first)  # seeds are those of the replicates
    default, oracle = (first[:, study.METHODS.index(m), :, 0] for m in ("default", "oracle"))
    assert np.sqrt((default**2).mean()) < 1.5 * np.sqrt((oracle**2).mean())


@pytest.mark.long
def test_the_command_runs_from_nothing(tmp_path):
    command = [sys.executable, str(FOLDER / "study.py"), "--replicates", "50", "--jobs", "2"]
    kept = (FOLDER / "result.md").read_text(encoding="utf-8")
    try:
        subprocess.run([*command, "--folder", str(tmp_path)], check=True, capture_output=True)
        assert "| table 1, 6 repeats |" in (FOLDER / "result.md").read_text(encoding="utf-8")
    finally:
        (FOLDER / "result.md").write_text(kept, encoding="utf-8")
