"""What a plan promises and what each pose is worth, against direct computation."""

from __future__ import annotations

import numpy as np
from scipy import stats
from support.cells import kr270_cell, kr270_chain

from elastocal.identification.solve import Reduction
from elastocal.model.manipulator import Model
from elastocal.planning.information import Estimable
from elastocal.planning.plan import predicted, reasons

MODEL = Model.assembled(kr270_chain(), kr270_cell(("joint_compliance",), "deflection"))
SIZES = np.full(6, 1e-7)


def found(kept: list[int], dropped: list[int], mixing: np.ndarray) -> Estimable:
    none = np.zeros(0, dtype=np.int64)
    reduction = Reduction(np.array(kept), np.array(dropped, dtype=np.int64), mixing, none)
    return Estimable(reduction, SIZES, reduction)


ALL = found(list(range(6)), [], np.zeros((6, 0)))


def test_predicted_intervals_are_those_of_the_inverse() -> None:
    rng = np.random.default_rng(0)
    B = rng.normal(size=(40, 6))
    told = predicted(MODEL, ALL, B.T @ B, 40)
    std = np.sqrt(np.diag(np.linalg.inv(B.T @ B))) * 1e-7
    assert np.allclose([p.std for p in told], std, rtol=1e-12)
    assert np.allclose([p.half_width for p in told], stats.t.ppf(0.975, 34) * std)
    assert [p.unit for p in told] == ["rad/(N*m)"] * 6


def test_a_pose_is_worth_what_is_lost_without_it() -> None:
    rng = np.random.default_rng(1)
    blocks, prior = rng.normal(size=(7, 3, 6)), 0.1 * np.eye(6)
    M = prior + np.einsum("nri,nrj->ij", blocks, blocks)
    full = np.sqrt(np.diag(np.linalg.inv(M)))
    told = reasons(MODEL, ALL, blocks, prior, np.arange(2.0, 9.0), 2.0)
    for B, reason, without in zip(blocks, told, np.arange(2.0, 9.0), strict=True):
        growth = np.sqrt(np.diag(np.linalg.inv(M - B.T @ B))) / full
        order = np.argsort(-growth)[:3]
        assert reason.loss == without / 2.0
        assert [name for name, _ in reason.serves] == [MODEL.names[k] for k in order]
        assert np.allclose([g for _, g in reason.serves], growth[order], rtol=1e-9)
