"""The worked example of docs/adding-an-effect.md does what the page says, as it stands there."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import kr270_chain, random_table
from support.registered import forgotten, write_example

from elastocal.cell.arm_description import EffectChoice, ModelSpec, Robot, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.identification.identify import identify
from elastocal.model.effects.catalogue import CATALOGUE, register
from elastocal.model.manipulator import Model
from elastocal.plugin_loader import load_plugins


@pytest.fixture(autouse=True)
def _registered(tmp_path: Path) -> Iterator[None]:
    """The page's file, run as a cell would have it run."""
    assert "three_lobes" not in CATALOGUE
    write_example(tmp_path, "three_lobes.py")
    with forgotten():
        load_plugins(tmp_path / "cell.toml", [str(tmp_path / "three_lobes.py")])
        yield


def model_with(effects: list[str]) -> Model:
    markers = {"M1": np.array([0.2, 0.05, 0.1])}
    spec = ModelSpec(effects=tuple(EffectChoice(*e.split(":")) for e in effects))
    return Model.assembled(
        kr270_chain(), Cell("kr", None, Robot(), Tool(markers=markers), model=spec)
    )


def test_it_is_one_more_entry_of_the_catalogue() -> None:
    model = model_with(["three_lobes"])
    assert len(model.parameters) == 12
    assert model.names[2:4] == ("joint2.lobes_sin", "joint2.lobes_cos")
    assert model_with(["three_lobes:joint2"]).names == model.names[2:4]


def test_it_acts_behind_the_last_effect_of_its_stage() -> None:
    names = list(CATALOGUE)
    before = names[: names.index("three_lobes")]
    later = names[names.index("three_lobes") + 1 :]
    assert before[-1] == "hysteresis"
    assert not any(CATALOGUE[name].stage == "transmission" for name in later)


def test_its_columns_are_derivatives() -> None:
    model = model_with(["three_lobes"])
    table = random_table(model.chain, 5, seed=1, markers=("M1",))
    B = model.regressor(table).B
    for k in range(len(model.parameters)):
        x = model.nominal.astype(complex)
        x[k] += 1e-30j
        np.testing.assert_allclose(B[:, k], model.predict(table, x).imag / 1e-30, atol=1e-13)


def test_identification_knows_it_at_once() -> None:
    model = model_with(["three_lobes:joint2", "three_lobes:joint3"])
    truth = np.array([3e-4, -2e-4, 1e-4, 2e-4])
    table = random_table(model.chain, 40, seed=2, markers=("M1",))
    rng = np.random.default_rng(3)
    exact = model.predict(table, truth).reshape(-1, 3)
    found = identify(model, replace(table, position=exact + 2e-5 * rng.normal(size=exact.shape)))
    for value, estimate in zip(truth, found.estimates, strict=True):
        assert estimate.std < 1e-5
        assert abs(estimate.value - value) < 4 * estimate.std


def test_two_effects_with_a_parameter_of_one_name_are_refused() -> None:
    class Alike(type(CATALOGUE["three_lobes"])):  # type: ignore[misc]
        name = "alike"

    register(Alike())
    told = r"three_lobes and alike both have a parameter 'joint2\.lobes_sin'"
    with pytest.raises(InputError, match=told):
        model_with(["three_lobes:joint2", "alike"])
