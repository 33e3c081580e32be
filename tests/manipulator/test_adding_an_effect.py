"""The worked example of docs/adding-an-effect.md does what the page says, as it stands there."""

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import kr270_chain, random_table

from elastocal.cell import Cell, EffectChoice, ModelSpec, Robot, Tool
from elastocal.identification.identify import identify
from elastocal.manipulator.effects import CATALOGUE
from elastocal.manipulator.model import Model

PAGE = Path(__file__).parents[2] / "docs" / "adding-an-effect.md"


@pytest.fixture
def effect(tmp_path, monkeypatch):
    """The page's file, imported, and the page's line in the catalogue."""
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S).group(1)
    path = tmp_path / "joint_temperature.py"
    path.write_text(code, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("joint_temperature", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "joint_temperature", module)
    spec.loader.exec_module(module)
    added = module.JointTemperature()
    assert added.name not in CATALOGUE
    monkeypatch.setitem(CATALOGUE, added.name, added)
    return added


def model_with(effects):
    markers = {"M1": np.array([0.2, 0.05, 0.1])}
    spec = ModelSpec(effects=tuple(EffectChoice(*e.split(":")) for e in effects))
    return Model.assembled(
        kr270_chain(), Cell("kr", None, Robot(), Tool(markers=markers), model=spec)
    )


def test_it_is_one_more_entry_of_the_catalogue(effect):
    model = model_with(["joint_temperature"])
    assert len(model.parameters) == 6
    assert model.names[1] == "joint2.temperature_shift"
    assert model_with(["joint_temperature:joint2"]).names == model.names[1:2]


def test_its_columns_are_derivatives(effect):
    model = model_with(["joint_temperature"])
    table = random_table(model.chain, 5, seed=1, markers=("M1",))
    B = model.regressor(table).B
    for k in range(len(model.parameters)):
        x = model.nominal.astype(complex)
        x[k] += 1e-30j
        np.testing.assert_allclose(B[:, k], model.predict(table, x).imag / 1e-30, atol=1e-13)


def test_identification_knows_it_at_once(effect):
    model = model_with(["joint_temperature:joint2", "joint_temperature:joint3"])
    truth = np.array([3e-5, -2e-5])
    table = random_table(model.chain, 40, seed=2, markers=("M1",))
    rng = np.random.default_rng(3)
    exact = model.predict(table, truth).reshape(-1, 3)
    found = identify(model, replace(table, position=exact + 2e-5 * rng.normal(size=exact.shape)))
    for value, estimate in zip(truth, found.estimates, strict=True):
        assert estimate.std < 1e-5
        assert abs(estimate.value - value) < 4 * estimate.std
