"""Warnings: each appears when its cause is there.  Tables that contradict the robot are refused
before anything is fitted, with the remedy."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import (
    GEOMETRY,
    PLACED,
    campaign,
    cell_of,
    measured,
    planar_chain,
    table_at,
    true_values,
    with_values,
)
from support.cells import random_poses

from elastocal.cell_tables import Nominal
from elastocal.identification.identify import identify
from elastocal.identification.start import check_limits
from elastocal.messages import InputError, InsufficientDataError
from elastocal.model.manipulator import Model

SIGMA = 5e-5


def identified(effects, change=lambda table: table, **how):
    model, table, _ = campaign(effects, **how)
    return identify(model, change(table))


def test_few_poses():
    """9 parameters from 5 poses: 6 degrees of freedom; with 6 poses there are enough, 9."""
    result = identified(PLACED, poses=5)
    said = f"Only {result.dof} degrees of freedom for {len(result.determined)}"
    (warning,) = (w for w in result.warnings if w.startswith(said))
    assert warning.endswith("Measure more poses.")
    assert not any("degrees of freedom for" in w for w in identified(PLACED, poses=6).warnings)


STIFF = {"nominal": Nominal(joint_compliance=(2e-5,) * 3)}
STATES = [[0, 0, 0], [200, 0, -400]]


@pytest.mark.parametrize("loads", [[[0, 0, 0]], STATES])
def test_ill_conditioned(loads):
    """Joint 3 moves by ±0.02° only, or loads alone tell link 3 from markers: under low noise."""
    q, elastic = random_poses(planar_chain(), 60, 0), len(loads) > 1
    q[:, 2] = q[:, 2] if elastic else 0.5 + 2e-4 * q[:, 2]
    cell = cell_of(("base_frame", "link_geometry", "marker_position", "joint_compliance"), **STIFF)
    model = Model.assembled(planar_chain(), cell)
    rng, plan = np.random.default_rng(0), table_at(q, loads)
    result = identify(model, measured(model, plan, true_values(model, rng), 1e-10, rng))
    (warning,) = (w for w in result.warnings if w.startswith("Ill-conditioned (condition number"))
    assert ("Fix one" if elastic else "the joints differ more, or fix one of these") in warning
    named = warning.split("barely separate ")[1].split(". ")[0].split(", ")
    assert len(named) == 3 and set(named) <= set(result.determined)


def test_a_parameter_beyond_its_bound():
    model = Model.assembled(planar_chain(), cell_of(("base_frame", "joint_compliance"), **STIFF))
    truth = with_values(model, {"joint3.compliance": -1e-5})
    plan, rng = table_at(random_poses(model.chain, 30, 0), STATES), np.random.default_rng(0)
    (warning,) = identify(model, measured(model, plan, truth, 20 * SIGMA, rng)).warnings
    assert warning.startswith("joint3.compliance = -1")
    assert "lies beyond its physical bound 0: check load direction and torque signs" in warning


@pytest.mark.parametrize("alike", [False, True])
def test_too_many_outliers_are_no_reading_errors_unless_they_follow_each_other(alike):
    rows = np.arange(10, 16) if alike else np.arange(1, 50, 9)
    by = 0.01 if alike else 0.01 * np.random.default_rng(0).normal(size=(6, 3))

    def spoilt(table):
        position = table.position.copy()
        position[rows] += by
        return replace(table, position=position)

    result = identified(PLACED, poses=50, change=spoilt)
    assert [o.line for o in (result.excluded if alike else result.outliers)] == list(rows + 2)
    told = result.finding("faulty_readings")
    assert told.numbers["shifted"] == 6 * alike
    if alike:
        assert "One common shift explains lines 12 to 17 by 17.4 mm" in told.remedy
    else:
        assert "(lines 3, 12, 21, 30, 39, 48)" in " ".join(result.warnings)


def test_a_missing_effect_in_one_load_state_is_no_shift():
    """Compliances that the model lacks move a loaded fifth of the readings, each otherwise."""
    true = Model.assembled(planar_chain(), cell_of((*PLACED, "joint_compliance"), **STIFF))
    rng = np.random.default_rng(0)
    plan = table_at(random_poses(true.chain, 60, 0), STATES)
    loaded = plan.force.any(axis=1)
    plan = plan.take(np.flatnonzero(loaded == (plan.configuration >= 48)))
    rigid = Model.assembled(true.chain, cell_of(PLACED))
    result = identify(rigid, measured(true, plan, true_values(true, rng), SIGMA, rng))
    assert result.excluded == () and not result.verdict.trusted


def test_what_the_pose_has_in_common_is_no_fault_in_time():
    """Six readings of each pose, one after the other: some poses are off, here and there."""
    model, rng = Model.assembled(planar_chain(), cell_of(PLACED)), np.random.default_rng(0)
    plan = table_at(random_poses(model.chain, 40, 0), STATES * 3)
    plan = measured(model, plan, true_values(model, rng), SIGMA, rng)
    off = np.isin(plan.configuration, rng.permutation(40)[:8])
    by = 0.01 * off[:, None] * rng.normal(size=plan.position.shape)
    spoilt = replace(plan, position=plan.position + by)
    result = identify(model, spoilt)
    assert result.outliers and result.excluded == ()


# What is refused before anything is fitted


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
    """±5° read as ±5 rad: no turn is wound.  Readings that another count of a joint explains."""
    q = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    q[:, 0] = np.linspace(3.5, 6, 20)
    told = "most lines are beyond.*probably degrees given as radians .or the reverse., or another"
    refused(model, table_for(model, q=q), InputError, told)
    arm, table, _ = campaign(PLACED)
    told = "beyond its limits.*with coupling { joint = 3, of = 2, factor = -1 } they would fit to"
    refused(arm, replace(table, q=table.q @ [[1, 0, 0], [0, 1, 1], [0, 0, 1]]), InputError, told)


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


def test_readings_that_depend_on_nothing_that_is_fitted():
    """Compliances without any load: not one parameter is seen."""
    model = Model.assembled(planar_chain(), cell_of(("joint_compliance",)))
    told = "do not depend on any parameter.*measure other poses or loads, or choose other effects"
    refused(model, (table := table_for(model)), InsufficientDataError, told)
    table.position[3] += 200.0
    refused(model, table, InsufficientDataError, "beside the reading of line 5, which is 3.. m off")
