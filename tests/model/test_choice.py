"""What the cell asks for: effects and places by name, markers, nominal values, and mistakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import COMPLIANCE, MARKERS, kr270_cell, kr270_chain, random_table
from support.registered import forgotten, write_example

from elastocal.cell_tables import Nominal
from elastocal.files import load_plugins
from elastocal.messages import InputError
from elastocal.model.effects.base import Arm, DrivenEffect
from elastocal.model.effects.catalogue import CATALOGUE, register
from elastocal.model.manipulator import Model


def model_of(*effects: str, **model) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects, **model))


def test_weights_without_masses_are_refused() -> None:
    massless = replace(kr270_chain(), masses=())
    cell = kr270_cell(("joint_compliance",), link_gravity=True)
    with pytest.raises(InputError, match=r"no masses: .*\[robot\] masses.*link_gravity = false"):
        Model.assembled(massless, cell)
    Model.assembled(massless, kr270_cell(("joint_compliance",)))


def test_an_unknown_marker_in_the_table_is_refused() -> None:
    model = model_of("joint_offset")
    table = random_table(model.chain, 1, seed=0, markers=("M1", "M2", "M9"))
    with pytest.raises(InputError, match=r"table: marker 'M9' is not one of .*: M1, M2, M3"):
        model.regressor(table)
    known = table.take(table.marker < 2)
    assert np.isfinite(model.regressor(known).B).all()  # a label without rows does no harm


def test_compliances_must_be_one_per_joint() -> None:
    nominal = Nominal(joint_compliance=(1e-6,) * 5)
    with pytest.raises(InputError, match=r"joint_compliance has 5 values.*has 6 joints"):
        model_of("joint_compliance", nominal=nominal)


@pytest.mark.parametrize(
    "effect, stated, told",
    [
        ("encoder_jump:joint2", {}, r"nominal.settings.joint2.* jump_time_s is missing"),
        ("joint_drift:joint2", {"joint2": {"time_constant_s": 59.0}}, "time_constant_s takes"),
        ("gear_ripple:joint1", {"joint1": {"ripple_order": 1001.0}}, "ripple_order takes"),
        ("encoder_jump:joint1", {"joint1": {"jump_time_s": np.nan}}, "jump_time_s takes"),
        ("joint_offset", {"joint2": {"jump_times": 3.0}}, "joint2 'jump_times'.*'jump_time_s'"),
        ("joint_offset", {"join2": {"jump_time_s": 3.0}}, "'join2'.*did you mean 'joint"),
        ("joint_offset", {"base": {"jump_time_s": 3.0}}, "base 'jump_time_s'.*time_constant_s"),
    ],
)
def test_settings_are_there_in_their_range_and_of_some_effect(effect, stated, told) -> None:
    with pytest.raises(InputError, match=told):
        model_of(effect, nominal=Nominal(settings=stated))


@pytest.mark.parametrize("name", [n for n, e in CATALOGUE.items() if isinstance(e, DrivenEffect)])
def test_what_drives_an_effect_is_linear_in_its_parameters(name: str) -> None:
    """One motion of the entry per place that it enters at, D(row) p."""
    effect, chain = CATALOGUE[name], kr270_chain()
    # Lines and smooth functions have no parameters where no setting asks for any.
    asked = {"order_1": 8.0, "order_sd_1": 0.1, "field_joint2_size": 1e-4, "field_time_size": 1e-4}
    places = effect.places(chain, kr270_cell())
    # Upright, no weight would turn joint 1.
    tilted = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    settings = dict.fromkeys(places, asked)
    cell = kr270_cell(nominal=Nominal(base_rotation=tilted, settings=settings))
    for place in places:
        arm = Arm(chain, cell)
        keys = [s.key for s in effect.parameters(place, chain, cell)]
        p = {key: ca.SX.sym(key) for key in keys}
        constants = {s.key: ca.SX(7.0) for s in effect.settings(place, chain, cell)}
        u = effect.drive(arm, place, p | constants)
        vector = ca.vertcat(*p.values())
        assert u.shape == (effect.entry_at(place).size * len(effect.entered_at(place, chain)), 1)
        D = ca.jacobian(u, vector)
        assert not ca.depends_on(D, vector)
        assert ca.substitute(u, vector, 0 * vector).is_zero()
        assert D.nnz() >= len(keys)


def test_every_effect_vanishes_at_its_nominal_parameters() -> None:
    """Of those that diagnosis adds to a model that explains everything else."""
    chain = kr270_chain()
    settings = {f"joint{i}": {"jump_time_s": 3e3, "ripple_order": 8.0} for i in range(1, 7)}
    once = ("tracker", "tool", *(f"link{i}" for i in range(1, 6)))
    settings |= {place: {"jump_time_s": 3e3} for place in once}
    settings |= {f"marker:{name}": {"slip_time_s": 3e3} for name in MARKERS}
    for place in CATALOGUE["residual_step"].places(chain, kr270_cell()):
        settings[place] = settings.get(place, {}) | {"step_time_s": 3e3}
    nominal = Nominal(COMPLIANCE, settings=settings)
    table = random_table(chain, 4, seed=9)
    plain = Model.assembled(
        chain, kr270_cell(["joint_compliance"], nominal=nominal, link_gravity=True)
    )
    names = set(CATALOGUE) - {"joint_compliance"}
    all_of_it = Model.assembled(
        chain, kr270_cell(["joint_compliance", *names], nominal=nominal, link_gravity=True)
    )
    difference = all_of_it.predict(table) - plain.predict(table)
    assert np.abs(difference).max() < 1e-14


def test_the_example_of_the_page_is_one_more_effect(tmp_path: Path) -> None:
    """It acts behind the last effect of its stage, and no other may have its parameters' names."""
    with forgotten():
        load_plugins(tmp_path / "cell.toml", [str(write_example(tmp_path, "three_lobes.py"))])
        names = list(CATALOGUE)
        k = names.index("three_lobes")
        assert CATALOGUE[names[k - 1]].stage == "transmission"
        assert not any(CATALOGUE[name].stage == "transmission" for name in names[k + 1 :])
        assert model_of("three_lobes:joint2").names == ("joint2.lobes_sin", "joint2.lobes_cos")

        class Alike(type(CATALOGUE["three_lobes"])):  # type: ignore[misc]
            name = "alike"

        register(Alike())
        told = r"three_lobes and alike both have a parameter 'joint2\.lobes_sin'"
        with pytest.raises(InputError, match=told):
            model_of("three_lobes:joint2", "alike")
