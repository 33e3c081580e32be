"""Tables that contradict the robot are refused before anything is fitted, with the remedy."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import (
    GEOMETRY,
    cell_of,
    measured,
    planar_chain,
    table_at,
    true_values,
)
from support.cells import random_poses

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.start import check_limits, check_table, fixed_and_free
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model


@pytest.fixture
def model():
    return Model.assembled(planar_chain(), cell_of(GEOMETRY))


def table_for(model, n=20, seed=0, q=None):
    rng = np.random.default_rng(seed)
    plan = table_at(random_poses(model.chain, n, seed) if q is None else q)
    return measured(model, plan, true_values(model, rng), 5e-5, rng)


def refused(model, table, error, *parts):
    """`identify` and `check_table` both refuse, with every part in the message."""
    for check in (check_table, identify):
        with pytest.raises(error) as caught:
            check(model, table)
        for part in parts:
            assert part in str(caught.value)
    assert caught.value.exit_code == (1 if error is InsufficientDataError else 2)


def test_the_cells_limits_narrow_the_robots():
    cell = replace(cell_of(GEOMETRY), limits={"joint2": (-0.5, 0.5), "joint3": (-9.0, 9.0)})
    model = Model.assembled(planar_chain(), cell)
    lower, upper = joint_limits(model.cell, model.chain)
    np.testing.assert_allclose(lower, [-3.0, -0.5, -2.5])
    np.testing.assert_allclose(upper, [3.0, 0.5, 2.5])
    q = np.zeros((20, 3))
    q[3, 1] = 0.5 + np.radians(0.4)  # controllers overshoot a little
    check_limits(model, table_at(q))
    q[3, 1] = 0.6
    with pytest.raises(InputError, match=r"line 5: joint2 \(q2\) at 34\.38° is beyond its limits"):
        check_limits(model, table_at(q))


def test_small_angles_in_degrees_taken_for_radians(model):
    """±5° read as ±5 rad: no turn is wound, but most lines lie beyond the limits."""
    q = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    q[:, 0] = np.linspace(3.5, 6, 20)
    refused(model, table_for(model, q=q), InputError, "most lines are beyond",
            "probably degrees given as radians (or the reverse), or another robot")  # fmt: skip


def test_radians_in_columns_of_degrees(model):
    table = table_for(model)
    radians = replace(table, q=np.radians(table.q))
    refused(model, radians, InputError,
            "the joint angles are probably radians in columns named …_deg")  # fmt: skip


def test_fewer_equations_than_parameters(model):
    with pytest.raises(InsufficientDataError) as caught:
        identify(model, table_for(model, n=4))
    assert str(caught.value).startswith(
        f"table.csv: 12 equations from 4 readings cannot determine the model's {len(model.names)} "
        "parameters and their uncertainty; measure more poses"
    )
    assert "or fit fewer effects" in str(caught.value)
    assert caught.value.exit_code == 1


def test_the_test_table_is_checked_too(model):
    other = table_for(model, seed=1)
    wrong = replace(other, position=other.position * 1e3, source="other.csv")
    with pytest.raises(InputError, match=r"other\.csv: the readings extend over .* millimetres"):
        identify(model, table_for(model), test=wrong)


def test_fixed_names_places_and_effects(model):
    names = np.array(model.names)
    everything = set(names)
    for fixed, left_out in (
        ((), set()),
        (("link2.dx",), {"link2.dx"}),
        (("link2",), {n for n in names if n.startswith("link2.")}),
        (("base_frame", "joint1.offset"), {n for n in names if n.startswith("base.")}
         | {"joint1.offset"}),
    ):  # fmt: skip
        assert set(names[fixed_and_free(model, fixed)]) == everything - left_out


def test_an_unknown_fixed_name(model):
    with pytest.raises(InputError) as caught:
        identify(model, table_for(model), Options(fixed=("link2.dxx",)))
    hint = "the model has no such parameter, place or effect (did you mean 'link2.dx'?)"
    assert str(caught.value) == f"fixed=['link2.dxx']: {hint}"


def test_readings_that_depend_on_nothing_that_is_fitted():
    """Compliances without any load: not one parameter is seen."""
    model = Model.assembled(planar_chain(), cell_of(("joint_compliance",)))
    with pytest.raises(InsufficientDataError, match="do not depend on any parameter") as caught:
        identify(model, table_for(model))
    assert "measure other poses or loads, or choose other effects" in str(caught.value)
