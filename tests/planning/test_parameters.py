"""Which parameters a plan can make certain, and what is said of the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.cells import DOWN, TABLE_2, kr270_chain, random_poses
from support.design_cells import FULL, any_cell, plan_cell, scara, setup_of, spread

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.model.manipulator import Model
from elastocal.planning import information as parameters
from elastocal.planning.information import Known, PoseInformation
from elastocal.simulation import simulate

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
SIDEWAYS = np.array([0.0, 1500.0, 0.0])
POSES = random_poses(CHAIN, 120, seed=1)


def stacked(cell: Cell, q: NDArray, chain: Any = CHAIN) -> tuple[Model, NDArray]:
    """B of all parameters, scaled to columns of equal length."""
    model = Model.assembled(chain, cell)
    n = len(model.names)
    found = PoseInformation(model, model.nominal, np.arange(n), np.ones(n)).blocks(q)
    B = found.reshape(-1, n)
    length = np.linalg.norm(B, axis=0)
    return model, B / np.where(length > 0, length, 1.0)


def test_a_vertical_load_does_not_show_the_compliance_of_a_vertical_joint() -> None:
    setup = setup_of(plan_cell(loads=DOWN[None]), POSES)
    assert setup.information.names == tuple(f"joint{i}.compliance" for i in range(2, 7))
    assert len(setup.warnings) == 1
    assert "no feasible pose shows joint1.compliance" in setup.warnings[0]
    slanted = setup_of(plan_cell(loads=np.array([DOWN, SIDEWAYS])), POSES)
    assert len(slanted.information.names) == 6
    assert slanted.warnings == ()


@pytest.mark.parametrize(
    ("chain", "cell"),
    [
        (CHAIN, plan_cell(FULL, "position", loads=BOTH)),
        (CHAIN, plan_cell((*FULL, "marker_orientation"), "pose", loads=BOTH)),
        (CHAIN, plan_cell(("distance_sensor", *FULL), "distance", loads=BOTH, criterion="D")),
        (scara(), any_cell(scara(), FULL, loads=BOTH / 20)),
    ],
    ids=["positions", "full poses", "distances", "scara"],
)
def test_the_kept_parameters_are_as_many_as_the_readings_determine(chain: Any, cell: Cell) -> None:
    """As many as the rank of all B together; the kept ones alone have that rank."""
    q = spread(chain, 120, 2)
    setup = setup_of(cell, q, chain)
    model, B = stacked(cell, q, chain)
    rank = np.linalg.matrix_rank(B, tol=1e-8 * np.sqrt(len(B)))
    kept = setup.found.columns
    assert len(kept) == rank < len(model.names)
    assert np.linalg.matrix_rank(B[:, kept], tol=1e-8 * np.sqrt(len(B))) == rank


def test_what_is_dropped_moves_the_readings_as_its_mixing_says() -> None:
    setup = setup_of(plan_cell(FULL, "position", loads=BOTH), POSES)
    model, r = setup.information.model, setup.found.reduction
    n = len(model.names)
    whole = PoseInformation(model, model.nominal, np.arange(n), setup.found.sizes)
    B = whole.blocks(TABLE_2).reshape(-1, n) / setup.found.sizes
    off = (B[:, r.dropped] - B[:, r.kept] @ r.mixing) * setup.found.sizes[r.dropped]
    assert np.abs(off).max() < 1e-6 * np.abs(B * setup.found.sizes).max()


# --- what counts --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("interest", "counted"),
    [
        ((), lambda p: p.effect not in ("base_frame", "marker_position")),
        (("joint_compliance",), lambda p: p.effect == "joint_compliance"),
        (("joint3", "base.x"), lambda p: p.where == "joint3" or p.name == "base.x"),
        (("joint2.offset",), lambda p: p.name == "joint2.offset"),
    ],
)
def test_interest_names_parameters_places_or_effects(interest: Any, counted: Any) -> None:
    cell = plan_cell(FULL, "position", loads=BOTH, criterion="A", interest=interest)
    setup = setup_of(cell, POSES)
    model, kept = setup.information.model, setup.found.columns
    chosen = parameters.interest_of(model, setup.found)
    expected = [k for k, c in enumerate(kept) if counted(model.parameters[c])]
    assert chosen.tolist() == expected
    V = np.linalg.inv(setup.gathered(setup.information.blocks(TABLE_2)))
    assert setup.value(TABLE_2) == pytest.approx(np.trace(V[np.ix_(chosen, chosen)]), rel=1e-8)


@pytest.mark.parametrize(
    ("interest", "error", "told"),
    [
        ("joint2.complience", InputError, ["did you mean 'joint2.compliance'", "interest"]),
        ("joint1.compliance", InsufficientDataError, ["no feasible pose shows", "fixed=['joint1"]),
        (
            "joint1.offset",
            InsufficientDataError,
            ["no set of poses separates", "base.rz", "fixed=["],
        ),
        ("joint4.compliance", InsufficientDataError, ["is held", "drop it from `fixed`"]),
    ],
)
def test_interest_in_what_cannot_be_known_is_answered(
    interest: str, error: type[Exception], told: list[str]
) -> None:
    effects = ("base_frame", "joint_offset", "joint_compliance")
    cell = plan_cell(effects, "position", loads=BOTH, criterion="D", interest=(interest,))
    with pytest.raises(error) as caught:
        setup_of(cell, POSES, known=Known(fixed=("joint4.compliance",)))
    assert interest in str(caught.value)
    assert not [part for part in told if part not in str(caught.value)], str(caught.value)


def test_a_combination_has_the_variance_of_its_terms() -> None:
    terms = {"joint2.compliance": 1.0, "joint3.compliance": -2.0}
    cell = plan_cell(loads=DOWN[None], criterion="c", combination=terms)
    setup = setup_of(cell, POSES)
    V = np.linalg.inv(setup.gathered(setup.information.blocks(TABLE_2)))
    V = V * np.outer(setup.information.sizes, setup.information.sizes)
    expected = V[0, 0] - 4 * V[0, 1] + 4 * V[1, 1]
    assert setup.value(TABLE_2) == pytest.approx(expected, rel=1e-9)
    assert setup.criterion.reported(setup.value(TABLE_2)) == pytest.approx(
        (np.sqrt(expected), "rad/(N*m)")
    )


def test_a_plan_estimates_what_identification_will() -> None:
    """Of fifteen poses both keep the same parameters; joint 6's offset, which only the load point
    tells from the markers, is below the noise and held by both."""
    cell = plan_cell(
        ("base_frame", "joint_offset", "joint_compliance", "marker_position"),
        "position",
        loads=BOTH,
    )
    setup = setup_of(cell, TABLE_2, n_poses=len(TABLE_2))
    model = setup.information.model
    rows = setup.information.rows(TABLE_2)
    data = simulate(model, rows, model.nominal, 3)
    result = identify(model, data, Options(method="wls", faulty="keep"))
    assert set(setup.information.names) == set(result.determined)
    assert "joint6.offset" not in setup.information.names
