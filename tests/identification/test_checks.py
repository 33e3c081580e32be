"""Tables that contradict the robot are refused before anything is fitted, with the remedy."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.identify import identify
from elastocal.identification.start import check_limits, fixed_and_free
from elastocal.model.manipulator import Model


@pytest.fixture
def model():
    return Model.assembled(planar_chain(), cell_of(GEOMETRY))


def table_for(model, n=20, seed=0, q=None):
    rng = np.random.default_rng(seed)
    plan = table_at(random_poses(model.chain, n, seed) if q is None else q)
    return measured(model, plan, true_values(model, rng), 5e-5, rng)


def refused(model, table, error, told, **more):
    with pytest.raises(error, match=told) as caught:
        identify(model, table, **more)
    assert caught.value.exit_code == (1 if error is InsufficientDataError else 2)


def test_the_cells_limits_narrow_the_robots():
    cell = replace(cell_of(GEOMETRY), limits={"joint2": (-0.5, 0.5), "joint3": (-9.0, 9.0)})
    model, q = Model.assembled(planar_chain(), cell), np.zeros((20, 3))
    q[3, 1] = 0.5 + np.radians(0.4)  # controllers overshoot a little
    check_limits(model, table_at(q))
    q[3, 1] = 0.6
    with pytest.raises(InputError, match=r"line 5: joint2 \(q2\) at 34\.38° is beyond its limits"):
        check_limits(model, table_at(q))
    q[3, 1:] = 0.5, 2.6
    with pytest.raises(InputError, match=r"joint3 \(q3\) at 149° is beyond its limits"):
        check_limits(model, table_at(q))


def test_small_angles_in_degrees_taken_for_radians(model):
    """±5° read as ±5 rad: no turn is wound, but most lines lie beyond the limits."""
    q = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    q[:, 0] = np.linspace(3.5, 6, 20)
    told = "most lines are beyond.*probably degrees given as radians .or the reverse., or another"
    refused(model, table_for(model, q=q), InputError, told)


def test_fewer_equations_than_parameters(model):
    told = (
        rf"^table.csv: 12 equations from 4 readings cannot determine the model's {len(model.names)}"
        " parameters and their uncertainty; measure more poses.*or fit fewer effects"
    )
    refused(model, table_for(model, n=4), InsufficientDataError, told)


def test_the_test_table_is_checked_too(model):
    other = table_for(model, seed=1)
    wrong = replace(other, position=other.position * 1e3, source="other.csv")
    told = r"other\.csv: the readings extend over .* millimetres"
    refused(model, table_for(model), InputError, told, test=wrong)


def test_fixed_names_places_and_effects(model):
    names = np.array(model.names)
    base = {n for n in names if n.startswith("base.")}
    for fixed, left_out in (
        ((), set()),
        (("link2.dx",), {"link2.dx"}),
        (("link2",), {n for n in names if n.startswith("link2.")}),
        (("base_frame", "joint1.offset"), base | {"joint1.offset"}),
    ):
        assert set(names[fixed_and_free(model, fixed)]) == set(names) - left_out


def test_readings_that_depend_on_nothing_that_is_fitted():
    """Compliances without any load: not one parameter is seen."""
    model = Model.assembled(planar_chain(), cell_of(("joint_compliance",)))
    told = "do not depend on any parameter.*measure other poses or loads, or choose other effects"
    refused(model, table_for(model), InsufficientDataError, told)
