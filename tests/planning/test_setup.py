"""What a plan is worth, against the covariance that identification gives to its readings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.cells import COMPENSATOR, COMPLIANCE, DOWN, TABLE_2, kr270_chain, random_poses
from support.design_cells import (
    any_cell,
    as_table,
    plan_cell,
    scara,
    setup_of,
    sliding_chain,
    spread,  # fmt: skip
)
from support.robots import packaged_urdf

from elastocal.cell.arm_description import Nominal, PolarNoise
from elastocal.cell.plan_wishes import TargetPose
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.identification.knowledge import GaussianPrior
from elastocal.identification.weighted_problem import weights_for
from elastocal.model.chain import Chain
from elastocal.model.dh import read_dh
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.model.urdf import read_urdf
from elastocal.planning import test_poses as target_poses
from elastocal.planning.information import Known
from elastocal.planning.test_poses import TargetPoses
from elastocal.simulation import expand_plan, simulate

CHAIN = kr270_chain()
BOTH = np.array([[0.0, 0, 0], DOWN])
POLAR = PolarNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
POSES = random_poses(CHAIN, 100, seed=1)
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
    """ρ₀² = Σ w tr(A cov Aᵀ), with A by differences of the flange's pose times the point."""
    model, root, size = covariance(cell, chain, q)
    table = replace(
        as_table(targets.q), force=targets.force, rotation=np.zeros((len(targets.q), 3))
    )

    def at(x: NDArray) -> NDArray:
        T = model.flange_poses(table, x)
        return np.einsum("tij,tj->ti", T[:, :3, :3], targets.point) + T[:, :3, 3]

    A = np.zeros((len(targets.q), 3, len(size)))
    for k, p in enumerate(model.parameters):
        h = np.zeros(len(size))
        h[k] = 1e-3 * (abs(p.nominal) or 1.0)
        A[..., k] = (at(model.nominal + h) - at(model.nominal - h)) / (2 * h[k])
    moved = (A / size) @ root
    return float(np.einsum("t,tij->", targets.weight, moved**2))


def dh_chain(folder: Any) -> Chain:
    """A Puma-like arm by its DH table."""
    file = folder / "dh.csv"
    rows = ["0,0,0,1.5708", "0,0,0.4318,0", "0,0.15,0.02,-1.5708", "0,0.43,0,1.5708",
            "0,0,0,-1.5708", "0,0.06,0,0"]  # fmt: skip
    file.write_text("theta0_rad,d_m,a_m,alpha_rad\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return read_dh(file)


SMALL = BOTH / 50
FEW = ("base_frame", "joint_offset", "joint_compliance")
CASES: dict[str, tuple[Any, Any]] = {
    "deflections": (CHAIN, lambda c: plan_cell(loads=DOWN[None], repeats=3)),
    "deflections of a sagging arm": (
        CHAIN, lambda c: plan_cell(loads=DOWN[None], model=SAGGING, noise=POLAR)
    ),
    "positions, polar": (CHAIN, lambda c: plan_cell(FEW, "position", POLAR, loads=BOTH)),
    "compensator": (
        CHAIN,
        lambda c: plan_cell((*FEW, "gravity_compensator"), "position", model=SAGGING, loads=BOTH),
    ),
    "full poses": (CHAIN, lambda c: plan_cell(FEW, "pose", loads=BOTH)),
    "scara": (scara(), lambda c: any_cell(c, FEW, loads=SMALL)),
    "sliding joints": (sliding_chain(), lambda c: any_cell(c, FEW, loads=SMALL)),
    "distances": (
        CHAIN,
        lambda c: plan_cell(("joint_compliance", "distance_sensor"), "distance", loads=BOTH),
    ),
    "7 axes, deflections": (
        "Panda", lambda c: any_cell(c, ("joint_compliance",), observe="deflection", loads=SMALL)
    ),
    "DH": (None, lambda c: any_cell(c, FEW, loads=SMALL)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_value_is_what_identification_would_leave_at_the_test_poses(
    case: str, tmp_path: Any
) -> None:
    chain, make = CASES[case]
    if isinstance(chain, str):
        path, flange = packaged_urdf(chain)
        chain = read_urdf(path, flange=flange)
    chain = chain or dh_chain(tmp_path)
    cell = make(chain)
    q = TABLE_2 if chain is CHAIN else spread(chain, 15, 2)
    poses = [TargetPose(p, weight=1.0 + k) for k, p in enumerate(spread(chain, 3, 3))]
    cell = replace(cell, design=replace(cell.design, test_poses=tuple(poses)))
    targets = target_poses.test_poses(cell, chain)
    setup = setup_of(cell, spread(chain, 80, 4), chain)
    expected = remaining_error(cell, chain, q, targets)
    value = setup.value(q)
    assert value == pytest.approx(expected, rel=1e-5)
    assert setup.criterion.reported(value) == (pytest.approx(1e6 * np.sqrt(expected)), "µm")


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
    assert setup.value(TABLE_2) < without.value(TABLE_2)


def test_a_prior_of_an_unknown_parameter_is_refused() -> None:
    prior = GaussianPrior.independent(("joint9.compliance",), [0.0], [1.0])
    with pytest.raises(InputError, match=r"joint9\.compliance.*did you mean"):
        setup_of(plan_cell(loads=DOWN[None]), POSES, known=Known(prior=prior))
