"""What the cell asks for: effects and places by name, markers, nominal values, and mistakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.cells import (
    COMPENSATOR,
    COMPLIANCE,
    MARKERS,
    choices,
    kr270_cell,
    kr270_chain,
    random_table,
)

from elastocal.cell.arm_description import Nominal, Robot, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.model import Model, choose_effects, load_chain
from elastocal.model.effects import CATALOGUE

NAMES = sorted(set(CATALOGUE) - {"payload", "link_gravity"})


def chosen(*effects: str, **model) -> list[tuple[str, str]]:
    cell = kr270_cell(effects, **model)
    return [(effect.name, place) for effect, place in choose_effects(kr270_chain(), cell)]


def model_of(*effects: str, **model) -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(effects, **model))


# --- names ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong, right",
    [
        ("joint_complience", "joint_compliance"),
        ("base_frames", "base_frame"),
        ("gravity_compensater", "gravity_compensator"),
        ("marker_positions", "marker_position"),
    ],
)
def test_an_unknown_effect_meets_its_nearest(wrong: str, right: str) -> None:
    with pytest.raises(InputError) as caught:
        chosen("joint_offset", wrong)
    text = str(caught.value)
    assert f"unknown effect '{wrong}'" in text and f"did you mean '{right}'?" in text
    assert "[model] effects" in text and "kr270" in text
    assert all(name in text for name in CATALOGUE)


@pytest.mark.parametrize(
    "wrong, right",
    [
        ("joint_compliance:joint7", "joint"),
        ("joint_compliance:jiont2", "joint2"),
        ("link_geometry:lnk3", "link3"),
        ("marker_position:marker:M4", "marker:M"),
        ("base_frame:bas", "base"),
    ],
)
def test_an_unknown_place_meets_its_nearest(wrong: str, right: str) -> None:
    name, _, place = wrong.partition(":")
    with pytest.raises(InputError) as caught:
        chosen(wrong)
    text = str(caught.value)
    assert f"unknown place of {name} '{place}'" in text
    assert f"did you mean '{right}" in text


def test_a_wrong_place_of_one_effect_is_found_beside_all_places_of_it() -> None:
    with pytest.raises(InputError, match="unknown place of joint_offset 'link1'"):
        chosen("joint_offset", "joint_offset:link1")


# --- places --------------------------------------------------------------------------------


def test_one_place_brings_only_its_parameters() -> None:
    model = model_of("joint_compliance:joint2")
    assert model.names == ("joint2.compliance",)
    assert model.deflection(random_table(model.chain, 1, seed=0)).shape[1] == 1
    (parameter,) = model.parameters
    assert (parameter.effect, parameter.where) == ("joint_compliance", "joint2")


def test_two_places_stand_in_the_chains_order() -> None:
    model = model_of("joint_offset:joint5", "joint_offset:joint2")
    assert model.names == ("joint2.offset", "joint5.offset")


def test_all_places_include_the_one_named() -> None:
    assert chosen("joint_offset", "joint_offset:joint2") == chosen("joint_offset")
    assert len(chosen("joint_offset")) == 7  # six joints and the payload


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_without_a_place_acts_at_all_of_them(name: str) -> None:
    places = CATALOGUE[name].places(kr270_chain(), kr270_cell())
    assert [place for effect, place in chosen(name) if effect == name] == list(places)


@pytest.mark.parametrize("name", NAMES)
def test_each_place_can_be_named(name: str) -> None:
    for place in CATALOGUE[name].places(kr270_chain(), kr270_cell()):
        assert [p for effect, p in chosen(f"{name}:{place}") if effect == name] == [place]


def test_the_compensator_stands_where_its_nominal_says() -> None:
    nominal = Nominal(COMPLIANCE, gravity_compensator=COMPENSATOR | {"joint": "joint3"})
    assert ("gravity_compensator", "joint2") in chosen("gravity_compensator")
    assert ("gravity_compensator", "joint3") in chosen("gravity_compensator", nominal=nominal)


# --- order and what is always there --------------------------------------------------------


@given(order=st.permutations(NAMES))
@settings(deadline=None)
def test_the_users_order_does_not_matter(order: list[str]) -> None:
    assert chosen(*order) == chosen(*NAMES)
    names = list(dict.fromkeys(effect for effect, _ in chosen(*order)))
    assert names == [name for name in CATALOGUE if name in names]


def test_parameters_stand_in_the_catalogues_order() -> None:
    model = model_of("marker_position", "joint_offset", "base_frame")
    effects = list(dict.fromkeys(parameter.effect for parameter in model.parameters))
    assert effects == ["base_frame", "joint_offset", "marker_position"]
    assert len(set(model.names)) == len(model.names)


@pytest.mark.parametrize("effects", [(), ("joint_offset",), ("payload",), ("payload:load",)])
def test_the_tables_force_always_acts(effects: tuple[str, ...]) -> None:
    assert chosen(*effects).count(("payload", "load")) == 1
    assert model_of(*effects).names == model_of(*(e for e in effects if "pay" not in e)).names


def test_the_tables_force_bends_an_arm_that_only_names_compliance() -> None:
    model = model_of("joint_compliance")
    table = random_table(model.chain, 2, seed=0)
    loaded = table.force.any(axis=1)
    theta = model.deflection(table)
    assert theta[loaded].all() and not theta[~loaded].any()


def test_a_rigid_model_has_no_effect_left() -> None:
    settings = {f"joint{i}": {"jump_time_s": 0.0, "ripple_order": 8.0} for i in range(1, 7)}
    settings |= {"tracker": {"jump_time_s": 0.0}}
    settings |= {f"marker:{name}": {"slip_time_s": 0.0} for name in MARKERS}
    nominal = Nominal(COMPLIANCE, settings=settings)
    rigid = model_of(*NAMES, link_gravity=True, nominal=nominal).rigid
    assert rigid.names == ()
    assert rigid.deflection(random_table(rigid.chain, 1, seed=0)).shape[1] == 0


def test_with_effects_is_the_same_arm_with_another_choice() -> None:
    model = model_of("joint_offset").with_effects(choices(["base_frame", "joint_offset:joint3"]))
    assert model.names == model_of("base_frame", "joint_offset:joint3").names


# --- weights -------------------------------------------------------------------------------


def test_weights_act_only_where_asked() -> None:
    assert not any(name == "link_gravity" for name, _ in chosen("joint_compliance"))
    weighed = chosen("joint_compliance", link_gravity=True)
    assert [place for name, place in weighed if name == "link_gravity"] == [
        f"link{i}" for i in range(1, 7)
    ]


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


def test_without_any_names_there_is_one_marker() -> None:
    assert Model(without_markers("marker_position")).names[0] == "marker:M1.x"


def test_the_cells_markers_win_over_the_tables() -> None:
    model = Model(kr270_cell(("marker_position",)), ("front",))
    assert model.names[::3] == ("marker:M1.x", "marker:M2.x", "marker:M3.x")
    np.testing.assert_array_equal(model.nominal, np.concatenate(list(MARKERS.values())))


def test_an_unknown_marker_in_the_table_is_refused() -> None:
    model = model_of("joint_offset")
    table = random_table(model.chain, 1, seed=0, markers=("M1", "M2", "M9"))
    with pytest.raises(InputError, match=r"table: marker 'M9' is not one of .*: M1, M2, M3"):
        model.regressor(table)
    known = table.take(table.marker < 2)
    assert np.isfinite(model.regressor(known).B).all()  # a label without rows does no harm


def test_an_unknown_marker_is_refused_where_the_cell_has_one_only() -> None:
    cell = replace(kr270_cell(("joint_offset",)), tool=Tool(markers={"M1": np.zeros(3)}))
    table = random_table(kr270_chain(), 1, seed=0, markers=("M1", "M9"))
    with pytest.raises(InputError, match="marker 'M9'"):
        Model.assembled(kr270_chain(), cell).predict(table)


# --- nominal values ------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 5, 7])
def test_compliances_must_be_one_per_joint(count: int) -> None:
    nominal = Nominal(joint_compliance=(1e-6,) * count)
    with pytest.raises(InputError, match=f"joint_compliance has {count} values.*has 6 joints"):
        model_of("joint_compliance", nominal=nominal)


def test_compliances_must_be_one_per_joint_for_bearings_too() -> None:
    with pytest.raises(InputError, match=r"joint_compliance has 5 values.*has 6 joints"):
        model_of("off_axis_compliance", nominal=Nominal(joint_compliance=(1e-6,) * 5))


def test_compliances_are_the_nominal_values() -> None:
    np.testing.assert_array_equal(model_of("joint_compliance").nominal, COMPLIANCE)
    unknown = model_of("joint_compliance", nominal=Nominal())
    assert not unknown.nominal.any()
    assert {parameter.typical for parameter in unknown.parameters} == {None}


@given(vector=st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array))
@settings(deadline=None)
def test_the_base_frame_starts_at_its_nominal(vector: np.ndarray) -> None:
    where = np.array([1.0, -2.0, 0.5])
    R = Rotation.from_rotvec(vector).as_matrix()
    nominal = model_of("base_frame", nominal=Nominal(None, where, R)).nominal
    np.testing.assert_array_equal(nominal[:3], where)
    np.testing.assert_allclose(Rotation.from_rotvec(nominal[3:]).as_matrix(), R, atol=1e-9)


def half_turn(*axis: float) -> np.ndarray:
    """2 n nᵀ − 1, symmetric to the last bit."""
    return 2 * np.outer(axis, axis) - np.eye(3)


@pytest.mark.parametrize(
    "R",
    [half_turn(0, 0, 1), half_turn(1, 0, 0), half_turn(0, 1, 0), half_turn(0.6, 0, 0.8),
     np.array([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]])],
    ids=["z", "x", "y", "oblique", "rpy 0 90 180"],
)  # fmt: skip
def test_the_base_may_be_half_turned(R: np.ndarray) -> None:
    """An arm that faces its tracker, or hangs from the ceiling."""
    nominal = model_of("base_frame", nominal=Nominal(base_rotation=R)).nominal
    found = Rotation.from_rotvec(nominal[3:]).as_matrix()
    np.testing.assert_allclose(found, R, rtol=0, atol=1e-7)


# --- robot ---------------------------------------------------------------------------------


def test_the_robot_is_read_from_the_cell() -> None:
    assert load_chain(kr270_cell()).name == kr270_chain().name


def test_a_cell_without_a_robot_is_refused() -> None:
    with pytest.raises(InputError, match=r"\[robot\] needs urdf, mjcf or dh"):
        load_chain(replace(kr270_cell(), robot=Robot()))
