"""Warnings: each appears when its cause is there, and none on a clean, adequate case."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import (
    GEOMETRY,
    PLACED,
    cell_of,
    measured,
    planar_chain,
    table_at,
    true_values,
    with_values,
)
from support.cells import random_poses

from elastocal.cell.arm_description import CartesianNoise, Nominal, Tracker
from elastocal.identification.identify import identify
from elastocal.model.manipulator import Model

SIGMA = 5e-5
SENTENCES = {
    "not converged": "The fit did not converge: ",
    "few": "degrees of freedom for",
    "alone": "Some configuration alone determines a parameter",
    "ill": "Ill-conditioned (condition number",
    "beyond bound": "lies beyond its physical bound",
    "outliers": "beyond what the noise explains",
    "share": "Too many for reading errors",
}


def kinds(result):
    """Which of the SENTENCES the warnings are; every warning must be one of them."""
    found = set()
    for warning in result.warnings:
        mine = {kind for kind, text in SENTENCES.items() if text in warning}
        assert len(mine) == 1, warning
        assert warning.endswith(".")
        found |= mine
    return found


def identified(model, seed=0, poses=30, sigma=SIGMA, options=None, truth=None, q=None, forces=None,
               change=lambda table: table):  # fmt: skip
    rng = np.random.default_rng(seed)
    truth = true_values(model, rng) if truth is None else truth
    q = random_poses(model.chain, poses, seed) if q is None else q
    plan = table_at(q, [[0, 0, 0]] if forces is None else forces)
    return identify(model, change(measured(model, plan, truth, sigma, rng)), options)


def text_of(result, kind):
    (warning,) = [w for w in result.warnings if SENTENCES[kind] in w]
    return warning


@pytest.mark.parametrize(("effects", "stated", "seed"), [(PLACED, True, 0), (GEOMETRY, False, 2)])
def test_a_clean_adequate_case_has_no_warning(effects, stated, seed):
    noise = CartesianNoise(np.full(3, SIGMA)) if stated else None
    model = Model.assembled(planar_chain(), cell_of(effects, tracker=Tracker(noise=noise)))
    assert identified(model, seed=seed, poses=40).warnings == ()


def test_few_poses():
    """9 parameters from 5 poses: 6 degrees of freedom."""
    result = identified(Model.assembled(planar_chain(), cell_of(PLACED)), poses=5)
    assert "few" in kinds(result)
    warning = text_of(result, "few")
    assert warning.startswith(f"Only {result.dof} degrees of freedom for {len(result.determined)}")
    assert warning.endswith("Measure more poses.")
    enough = identified(Model.assembled(planar_chain(), cell_of(PLACED)), poses=6)  # 9 for 9
    assert "few" not in kinds(enough)


def test_a_configuration_that_alone_determines_a_parameter():
    """Two markers, one of them read in a single configuration."""
    markers = {"M1": np.zeros(3), "M2": np.array([0.1, 0.1, 0.0])}
    model = Model.assembled(planar_chain(), cell_of(PLACED, markers))
    rng = np.random.default_rng(0)
    truth = true_values(model, rng)
    plan = table_at(random_poses(model.chain, 20, 0), markers=("M1", "M2"))
    plan = plan.take((plan.marker == 0) | (plan.configuration == 4))
    result = identify(model, measured(model, plan, truth, SIGMA, rng))
    assert kinds(result) == {"alone"}
    assert "Measure more configurations" in text_of(result, "alone")


def test_ill_conditioned():
    """Joint 3 moves by ±0.02° only: what it alone separates is barely separated."""
    model = Model.assembled(
        planar_chain(), cell_of(("base_frame", "link_geometry", "marker_position"))
    )
    q = random_poses(model.chain, 60, 0)
    q[:, 2] = 0.5 + 2e-4 * q[:, 2]
    # low noise, so that even the barely visible directions are worth a column
    result = identified(model, q=q, sigma=1e-10)
    assert "ill" in kinds(result)
    warning = text_of(result, "ill")
    assert "the data barely separate" in warning
    assert "in which the joints differ more, or fix one of these parameters" in warning
    named = warning.split("barely separate ")[1].split(". Measure")[0].split(", ")
    assert len(named) == 3 and set(named) <= set(result.determined)


STATES = [[0, 0, 0], [200, 0, -400]]


def test_a_parameter_beyond_its_bound():
    nominal = Nominal(joint_compliance=(2e-5,) * 3)
    effects = ("base_frame", "joint_compliance")
    model = Model.assembled(planar_chain(), cell_of(effects, nominal=nominal))
    truth = with_values(model, {"joint3.compliance": -1e-5})
    result = identified(model, truth=truth, forces=STATES, sigma=20 * SIGMA)
    assert kinds(result) == {"beyond bound"}
    assert text_of(result, "beyond bound").startswith("joint3.compliance = -1")
    assert "check load direction and torque signs" in text_of(result, "beyond bound")
    assert "fit with bounds" in text_of(result, "beyond bound")


@pytest.mark.parametrize("alike", [False, True])
def test_too_many_outliers_are_no_reading_errors_unless_one_shift_explains_them(alike):
    model, rows = Model.assembled(planar_chain(), cell_of(PLACED)), np.arange(10, 16)
    by = 0.01 if alike else 0.01 * np.random.default_rng(0).normal(size=(6, 3))

    def spoilt(table):
        position = table.position.copy()
        position[rows] += by
        return replace(table, position=position)

    result = identified(model, poses=50, change=spoilt)
    assert [o.line for o in (result.excluded if alike else result.outliers)] == list(rows + 2)
    told = result.finding("faulty_readings")
    if alike:
        assert told.numbers["shifted"] == 6
        assert "One common shift explains lines 12 to 17 by 17.4 mm" in told.remedy
    else:
        assert kinds(result) == {"outliers", "share"} and told.numbers["shifted"] == 0
        assert "(lines 12–17)" in text_of(result, "outliers")


def test_a_missing_effect_in_one_load_state_is_no_shift():
    """Compliances that the model lacks move a loaded fifth of the readings, each otherwise."""
    stiff = {"nominal": Nominal(joint_compliance=(2e-5,) * 3)}
    true = Model.assembled(planar_chain(), cell_of((*PLACED, "joint_compliance"), **stiff))
    rng = np.random.default_rng(0)
    plan = table_at(random_poses(true.chain, 60, 0), STATES)
    loaded = plan.force.any(axis=1)
    plan = plan.take(np.flatnonzero(loaded == (plan.configuration >= 48)))
    rigid = Model.assembled(true.chain, cell_of(PLACED))
    result = identify(rigid, measured(true, plan, true_values(true, rng), SIGMA, rng))
    assert result.excluded == () and not result.verdict.trusted
