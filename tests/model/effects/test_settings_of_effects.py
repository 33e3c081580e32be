"""Constants that are set, not fitted: where they come from, and mistakes."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import COMPLIANCE, MARKERS, kr270_cell, kr270_chain, random_table

from elastocal.cell.arm_description import Nominal
from elastocal.errors import InputError
from elastocal.model.arm import Arm
from elastocal.model.effects.base import DrivenEffect
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model


def model_with(settings: dict[str, dict[str, float]], *effects: str, **spec) -> Model:
    return Model.assembled(
        kr270_chain(), kr270_cell(effects, nominal=Nominal(settings=settings), **spec)
    )


@pytest.mark.parametrize(
    "effect, key",
    [
        ("encoder_jump:joint2", "joint2.* jump_time_s"),
        ("frame_jump", "tracker.* jump_time_s"),
        ("gear_ripple:joint3", "joint3.* ripple_order"),
    ],
)
def test_what_nobody_knows_beforehand_must_be_given(effect: str, key: str) -> None:
    with pytest.raises(InputError, match=f"nominal.settings.{key} is missing"):
        model_with({}, effect)


@pytest.mark.parametrize(
    "effect, place, key, value",
    [
        ("joint_drift:joint2", "joint2", "time_constant_s", 59.0),
        ("gear_ripple:joint1", "joint1", "ripple_order", 1001.0),
        ("encoder_jump:joint1", "joint1", "jump_time_s", np.nan),
    ],
)
def test_values_outside_their_range_are_refused(effect, place, key, value) -> None:
    with pytest.raises(InputError, match=f"{place}.* {key} takes"):
        model_with({place: {key: value}}, effect)


@pytest.mark.parametrize(
    "settings, parts",
    [
        ({"joint2": {"jump_times": 3.0}}, ["setting of joint2 'jump_times'", "'jump_time_s'"]),
        ({"join2": {"jump_time_s": 3.0}}, ["unknown place 'join2'", "did you mean 'joint"]),
        ({"base": {"jump_time_s": 3.0}}, ["setting of base 'jump_time_s'", "time_constant_s"]),
    ],
)
def test_a_setting_that_no_effect_has_meets_its_nearest(settings, parts) -> None:
    with pytest.raises(InputError) as caught:
        model_with(settings, "joint_offset")
    text = str(caught.value)
    assert "[model] nominal.settings" in text
    assert all(part in text for part in parts)


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
    settings |= {"tracker": {"jump_time_s": 3e3}}
    settings |= {f"marker:{name}": {"slip_time_s": 3e3} for name in MARKERS}
    nominal = Nominal(COMPLIANCE, settings=settings)
    table = random_table(chain, 4, seed=9)
    plain = Model.assembled(
        chain, kr270_cell(["joint_compliance"], nominal=nominal, link_gravity=True)
    )
    names = set(CATALOGUE) - {"joint_compliance"}
    all_of_it = Model.assembled(
        chain,
        kr270_cell(["joint_compliance", *names], nominal=nominal, link_gravity=True),
    )
    difference = all_of_it.predict(table) - plain.predict(table)
    assert np.abs(difference).max() < 1e-14


def sized(sizes: dict[str, dict[str, float]], *effects: str) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects, nominal=Nominal(sizes=sizes)))


@pytest.mark.parametrize(
    "sizes, message",
    [
        ({"joint9": {"offset": 1.0}}, "nominal.sizes: unknown place 'joint9'"),
        ({"joint2": {"ofset": 1.0}}, "unknown parameter of joint2 'ofset'"),
        ({"joint2": {"curve_1": 1.0}}, "unknown parameter of joint2 'curve_1'"),
    ],
)
def test_sizes_of_what_no_effect_has_are_refused(sizes, message) -> None:
    with pytest.raises(InputError, match=message):
        sized(sizes, "joint_offset")
