"""What a plan is worth, by the covariance that identification gives to its readings, and which
parameters it can make certain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.cells import COMPENSATOR, COMPLIANCE, DOWN, TABLE_2, kr270_chain, random_poses
from support.design_cells import FULL, any_cell, as_table, plan_cell, scara, setup_of, value_of

from elastocal.cell import Cell
from elastocal.cell_tables import Nominal, PolarNoise, TargetPose
from elastocal.identification.identify import identify
from elastocal.identification.knowledge import GaussianPrior
from elastocal.identification.start import Options
from elastocal.identification.weighted_problem import weights_for
from elastocal.messages import InsufficientDataError
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning import poses as target_poses
from elastocal.planning.information import Known, PoseInformation
from elastocal.planning.poses import TargetPoses, prediction_rows
from elastocal.simulation import expand_plan, simulate

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
POLAR = PolarNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
POSES = random_poses(CHAIN, 120, seed=1)
SIDEWAYS = np.array([0.0, 1500.0, 0.0])
SAGGING = {
    "link_gravity": True,
    "nominal": Nominal(joint_compliance=COMPLIANCE, gravity_compensator=COMPENSATOR),
}


def covariance(cell: Cell, chain: Chain, q: NDArray) -> tuple[Model, NDArray, NDArray]:
    """cov(X̂) of the readings of poses q: a simulated table, weighted as `identify` weighs it.

    Over a basis of what the readings show (parameters, rank), and the pseudo-inverse there.
    """
    model = Model.assembled(chain, cell)
    loads = np.zeros((1, 3)) if cell.design.loads is None else cell.design.loads
    load = loads[-1] if len(loads) > 1 or loads.any() else None
    table = expand_plan(as_table(q), tuple(cell.tool.markers), cell.design.repeats, load)
    table = simulate(model, table, model.nominal, 0, noise=False)
    observed = observe(table, model.observe)
    B = weights_for(observed, cell.tracker).apply(model.regressor(table, None, None, observed).B)
    size = np.linalg.norm(B, axis=0)
    size[size == 0] = 1.0
    _, s, turn = np.linalg.svd(B / size, full_matrices=False)
    shown = s > 1e-8 * s[0]
    return model, turn[shown].T / s[shown], size


def remaining_error(cell: Cell, chain: Chain, q: NDArray, targets: TargetPoses) -> float:
    """ρ₀² = Σ w tr(A cov Aᵀ); of A test_targets.py speaks."""
    model, root, size = covariance(cell, chain, q)
    A = prediction_rows(model, targets, model.nominal)
    moved = (A / size) @ root
    return float(np.einsum("t,tij->", targets.weight, moved**2))


SMALL = BOTH / 50
FEW = ("base_frame", "joint_offset", "joint_compliance")
CASES: dict[str, tuple[Chain, Cell]] = {
    "deflections of a sagging arm": (
        CHAIN, plan_cell(loads=DOWN[None], model=SAGGING, noise=POLAR, repeats=3)
    ),
    "positions, polar": (CHAIN, plan_cell(FEW, "position", POLAR, loads=BOTH)),
    "compensator": (
        CHAIN, plan_cell((*FEW, "gravity_compensator"), "position", model=SAGGING, loads=BOTH)
    ),
    "full poses": (CHAIN, plan_cell(FEW, "pose", loads=BOTH)),
    "scara": (scara(), any_cell(scara(), FEW, loads=SMALL)),
    "distances": (
        CHAIN, plan_cell(("joint_compliance", "distance_sensor"), "distance", loads=BOTH)
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_what_identification_would_leave_at_the_test_poses(case: str) -> None:
    chain, cell = CASES[case]
    q = TABLE_2 if chain is CHAIN else random_poses(chain, 15, 2)
    poses = [TargetPose(p, weight=1.0 + k) for k, p in enumerate(random_poses(chain, 3, 3))]
    cell = replace(cell, design=replace(cell.design, test_poses=tuple(poses)))
    targets = target_poses.test_poses(cell, chain)
    setup = setup_of(cell, random_poses(chain, 80, 4), chain)
    expected = remaining_error(cell, chain, q, targets)
    value = value_of(setup, q)
    assert value == pytest.approx(expected, rel=1e-5)
    assert setup.criterion.figure(value) == pytest.approx(1e6 * np.sqrt(expected))


# --- what is known before --------------------------------------------------------------------


def test_a_prior_adds_its_information() -> None:
    cell = plan_cell(loads=DOWN[None])
    names, std = ("joint2.compliance", "joint5.compliance"), np.array([1e-9, 2e-8])
    prior = GaussianPrior(names, np.zeros(2), np.diag(std**2))
    setup = setup_of(cell, POSES, known=Known(prior=prior))
    without = setup_of(cell, POSES)
    added = (setup.prior - without.prior) / np.outer(*[setup.information.sizes] * 2)
    expected = np.zeros_like(added)
    for name, s in zip(names, std, strict=True):
        k = setup.information.names.index(name)
        expected[k, k] = s**-2
    assert np.allclose(added, expected, rtol=1e-12)
    assert value_of(setup, TABLE_2) < value_of(without, TABLE_2)
    # What has a prior counts, however little that says.
    weak = GaussianPrior(("joint1.compliance",), np.zeros(1), np.diag([1e-2]))
    kept = setup_of(plan_cell(loads=DOWN[None]), POSES, known=Known(prior=weak)).information.names
    assert "joint1.compliance" in kept and "joint1.compliance" not in without.information.names


# --- which parameters --------------------------------------------------------------------------


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
        (CHAIN, plan_cell((*FULL, "marker_orientation"), "pose", loads=BOTH)),
        (CHAIN, plan_cell(("distance_sensor", *FULL), "distance", loads=BOTH)),
        (scara(), any_cell(scara(), FULL, loads=BOTH / 20)),
    ],
    ids=["full poses", "distances", "scara"],
)
def test_the_kept_parameters_are_as_many_as_the_readings_determine(chain: Any, cell: Cell) -> None:
    """As many as the rank of all B; what is dropped moves the readings as its mixing says."""
    q = random_poses(chain, 120, 2)
    setup = setup_of(cell, q, chain)
    model, r, sizes = setup.information.model, setup.found.reduction, setup.found.sizes
    n = len(model.names)
    B = PoseInformation(model, model.nominal, np.arange(n), sizes).blocks(q).reshape(-1, n)
    unit = B / np.maximum(np.linalg.norm(B, axis=0), 1e-300)
    ranks = [np.linalg.matrix_rank(b, tol=1e-8 * np.sqrt(len(B))) for b in (unit, unit[:, r.kept])]
    assert len(r.kept) == ranks[0] == ranks[1] < n
    off = B[:, r.dropped] - B[:, r.kept] / sizes[r.kept] @ r.mixing * sizes[r.dropped]
    assert np.abs(off).max() < 1e-6 * np.abs(B).max()


# --- what counts --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("interest", "counted"),
    [
        ((), lambda p: p.effect not in ("base_frame", "marker_position")),
        (("joint3", "base.x"), lambda p: p.where == "joint3" or p.name == "base.x"),
    ],
)
def test_interest_names_parameters_places_or_effects(interest: Any, counted: Any) -> None:
    cell = plan_cell(FULL, "position", loads=BOTH, criterion="A", interest=interest)
    setup = setup_of(cell, POSES)
    model, kept = setup.information.model, setup.found.columns
    chosen = setup.found.interest
    expected = [k for k, c in enumerate(kept) if counted(model.parameters[c])]
    assert chosen.tolist() == expected
    V = np.linalg.inv(setup.gathered(setup.information.blocks(TABLE_2)))
    assert value_of(setup, TABLE_2) == pytest.approx(np.trace(V[np.ix_(chosen, chosen)]), rel=1e-8)


def test_interest_in_what_no_poses_separate_is_answered() -> None:
    effects = ("base_frame", "joint_offset", "joint_compliance")
    cell = plan_cell(effects, "position", loads=BOTH, criterion="D", interest=("joint1.offset",))
    with pytest.raises(InsufficientDataError) as caught:
        setup_of(cell, POSES)
    for part in ("joint1.offset", "no set of poses separates", "base.rz", "fixed=["):
        assert part in str(caught.value), str(caught.value)


def test_a_combination_has_the_variance_of_its_terms() -> None:
    terms = {"joint2.compliance": 1.0, "joint3.compliance": -2.0}
    cell = plan_cell(loads=DOWN[None], criterion="c", combination=terms)
    setup = setup_of(cell, POSES)
    V = np.linalg.inv(setup.gathered(setup.information.blocks(TABLE_2)))
    V = V * np.outer(setup.information.sizes, setup.information.sizes)
    expected = V[0, 0] - 4 * V[0, 1] + 4 * V[1, 1]
    assert value_of(setup, TABLE_2) == pytest.approx(expected, rel=1e-9)
    assert setup.criterion.figure(value_of(setup, TABLE_2)) == pytest.approx(np.sqrt(expected))
    assert setup.criterion.unit == "rad/(N*m)"


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
    assert "joint6.offset" in setup_of(cell, TABLE_2).information.names  # of very many
