"""What the cell asks for: effects and places by name, markers, nominal values, and mistakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.cells import (
    kr270_cell,
    kr270_chain,
    random_table,
)

from elastocal.cell.arm_description import Nominal, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.model.effects.catalogue import CATALOGUE, choose_effects
from elastocal.model.manipulator import Model

NAMES = sorted(set(CATALOGUE) - {"payload", "link_gravity"})


def chosen(*effects: str, **model) -> list[tuple[str, str]]:
    cell = kr270_cell(effects, **model)
    return [(effect.name, place) for effect, place in choose_effects(kr270_chain(), cell)]


def model_of(*effects: str, **model) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects, **model))


# --- names ---------------------------------------------------------------------------------


def test_an_unknown_effect_meets_its_nearest() -> None:
    with pytest.raises(InputError) as caught:
        chosen("joint_offset", "joint_complience")
    text = str(caught.value)
    assert "unknown effect 'joint_complience'" in text and "mean 'joint_compliance'?" in text
    assert "[model] effects" in text and "kr270" in text
    assert all(name in text for name in CATALOGUE)


@pytest.mark.parametrize(
    "wrong, right",
    [
        ("joint_compliance:jiont2", "joint2"),
        ("marker_position:marker:M4", "marker:M"),
    ],
)
def test_an_unknown_place_meets_its_nearest(wrong: str, right: str) -> None:
    name, _, place = wrong.partition(":")
    with pytest.raises(InputError) as caught:
        chosen(wrong)
    text = str(caught.value)
    assert f"unknown place of {name} '{place}'" in text
    assert f"did you mean '{right}" in text


# --- order and what is always there --------------------------------------------------------


@given(order=st.permutations(NAMES))
@settings(deadline=None)
def test_the_users_order_does_not_matter(order: list[str]) -> None:
    assert chosen(*order) == chosen(*NAMES)
    names = list(dict.fromkeys(effect for effect, _ in chosen(*order)))
    assert names == [name for name in CATALOGUE if name in names]


@pytest.mark.parametrize("effects", [(), ("joint_offset",), ("payload",), ("payload:load",)])
def test_the_tables_force_always_acts(effects: tuple[str, ...]) -> None:
    assert chosen(*effects).count(("payload", "load")) == 1
    assert model_of(*effects).names == model_of(*(e for e in effects if "pay" not in e)).names


# --- weights -------------------------------------------------------------------------------


def test_weights_without_masses_are_refused() -> None:
    massless = replace(kr270_chain(), masses=())
    cell = kr270_cell(("joint_compliance",), link_gravity=True)
    with pytest.raises(InputError, match=r"no masses: .*\[robot\] masses.*link_gravity = false"):
        Model.assembled(massless, cell)
    Model.assembled(massless, kr270_cell(("joint_compliance",)))


# --- markers -------------------------------------------------------------------------------


def without_markers(*effects: str) -> Cell:
    return replace(kr270_cell(effects), tool=Tool())


def test_markers_are_the_tables_where_the_cell_lists_none() -> None:
    model = Model(without_markers("marker_position"), ("front", "back"))
    assert model.names[::3] == ("marker:front.x", "marker:back.x")
    assert not model.nominal.any()
    table = random_table(model.chain, 2, seed=0, markers=("back", "front"))
    x = np.array([1.0, 0, 0, 0, 0, 0])
    moved = np.linalg.norm((model.predict(table, x) - model.predict(table)).reshape(-1, 3), axis=1)
    np.testing.assert_allclose(moved, table.marker == 1, atol=1e-12)  # of "front", by its name


def test_an_unknown_marker_in_the_table_is_refused() -> None:
    model = model_of("joint_offset")
    table = random_table(model.chain, 1, seed=0, markers=("M1", "M2", "M9"))
    with pytest.raises(InputError, match=r"table: marker 'M9' is not one of .*: M1, M2, M3"):
        model.regressor(table)
    known = table.take(table.marker < 2)
    assert np.isfinite(model.regressor(known).B).all()  # a label without rows does no harm


# --- nominal values ------------------------------------------------------------------------


def test_compliances_must_be_one_per_joint() -> None:
    nominal = Nominal(joint_compliance=(1e-6,) * 5)
    with pytest.raises(InputError, match=r"joint_compliance has 5 values.*has 6 joints"):
        model_of("joint_compliance", nominal=nominal)


def half_turn(*axis: float) -> np.ndarray:
    """2 n nᵀ − 1, symmetric to the last bit."""
    return 2 * np.outer(axis, axis) - np.eye(3)


@pytest.mark.parametrize("R", [half_turn(1, 0, 0), half_turn(0.6, 0, 0.8)], ids=["x", "oblique"])
def test_the_base_may_be_half_turned(R: np.ndarray) -> None:
    """An arm that faces its tracker, or hangs from the ceiling."""
    nominal = model_of("base_frame", nominal=Nominal(base_rotation=R)).nominal
    found = Rotation.from_rotvec(nominal[3:]).as_matrix()
    np.testing.assert_allclose(found, R, rtol=0, atol=1e-7)
