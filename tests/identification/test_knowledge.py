"""Constraints and priors in the whole identification, and the file that states them."""

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from support.calibration import measured, with_values
from support.cells import DOWN, TABLE_2, kr270_cell, table_of

import elastocal as ec
from elastocal.identification.identify import identify
from elastocal.identification.knowledge import (
    Constraints,
    GaussianPrior,
    LinearEquality,
    read_knowledge,
)
from elastocal.identification.start import Options
from elastocal.measurements import Measurements
from elastocal.messages import InputError
from elastocal.model.manipulator import Model

SIGMA = 2e-4  # m, of a deflection: coarse, so that a stiff bearing is lost in the noise
BEARING_X, BEARING_Y = "joint2.off_axis_compliance_x", "joint2.off_axis_compliance_y"
DOCS = Path(__file__).parents[2] / "docs" / "file-formats.md"
WHOLE = Path(__file__).parents[1] / "golden" / "inputs" / "whole"


@lru_cache
def drives() -> Model:
    """Six drives, linear in them; the first cannot be seen under a vertical load."""
    return Model(kr270_cell(["joint_compliance"], observe="deflection", deflection_model="linear"))


def readings(model: Model, seed: int, force=DOWN, **values: float) -> Measurements:
    truth = with_values(model, values)
    plan = table_of(TABLE_2, np.asarray(force, dtype=float), both=model.observe == "deflection")
    return measured(model, plan, truth, SIGMA / 2**0.5, np.random.default_rng(seed))


def test_a_prior_is_the_ridge_of_the_linear_arm():
    """MAP in closed form on an arm that is linear in its compliances."""
    model, table = drives(), readings(drives(), 4)
    names = ("joint2.compliance", "joint6.compliance")
    prior = GaussianPrior.independent(names, [3e-7, 2e-6], [5e-9, 2e-7])
    alone = identify(model, table, Options(method="ols"))
    found = identify(model, table, Options(method="ols", prior=prior))
    columns = [model.names.index(n) for n in alone.determined]
    at = model.regressor(table, alone.x, np.array(columns), alone.observations)
    P = np.zeros((2, len(columns)))
    for row, name in enumerate(names):
        P[row, alone.determined.index(name)] = 1 / np.sqrt(prior.covariance[row, row])
    H = at.B.T @ at.B / alone.sigma**2 + P.T @ P
    target = P @ alone.x[columns] - prior.mean / np.sqrt(np.diag(prior.covariance))
    V = np.linalg.inv(H)
    np.testing.assert_allclose(found.x[columns], alone.x[columns] - V @ P.T @ target, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, V, rtol=1e-6, atol=1e-8 * np.abs(V).max())
    share = np.diag(V @ P.T @ P @ V) / np.diag(V)
    assert list(found.prior_share) == list(alone.determined)
    np.testing.assert_allclose(list(found.prior_share.values()), share, atol=1e-8)
    for n, std, s in zip(found.determined, np.sqrt(np.diag(V)), share, strict=True):
        e, dof = found[n], alone.dof / (1 - s) ** 2
        assert e.dof == pytest.approx(dof, rel=1e-5)
        assert e.ci95[1] - e.value == pytest.approx(stats.t.ppf(0.975, dof) * std, rel=1e-5)


def test_a_prior_on_one_of_a_pair_tells_the_other():
    """With a free base and an unknown marker base.rz and joint 1 turn the arm alike."""
    known, other = "joint1.offset", "base.rz"
    model = Model(kr270_cell(("base_frame", "joint_offset")))
    table = readings(model, 7)
    alone = identify(model, table)
    assert {known, other}.isdisjoint(e.name for e in alone.estimates if e.identifiable)
    mean, std = 2e-3, 1e-4
    prior = GaussianPrior.independent((known,), [mean], [std])
    found = identify(model, table, Options(prior=prior))
    assert found[known].value == pytest.approx(mean, rel=1e-6)
    assert found.prior_share[known] == pytest.approx(1.0)
    assert found.dof == alone.dof and found.sigma == pytest.approx(alone.sigma)
    assert found.heldout_rms == pytest.approx(alone.heldout_rms, rel=1e-6)
    # Both turn about the same axis, base.rz upwards and joint 1 downwards.
    combined = alone.combination("base.rz")
    sign = combined.terms["joint1.offset"]
    e = found[other]
    assert e.value == pytest.approx(combined.value - sign * mean, abs=2e-6)
    assert e.std == pytest.approx(np.hypot(std, combined.std), rel=0.01)
    assert not {known, other} & {n for c in found.combinations for n in c.terms}


def test_an_equality_is_the_fit_in_fewer_parameters():
    """joint2 = joint3 by adding their columns: x = T z on the linear arm."""
    model, table = drives(), readings(drives(), 8)
    alike = LinearEquality({"joint2.compliance": 1.0, "joint3.compliance": -1.0})
    found = identify(
        model, table, Options(method="ols", constraints=Constraints(equalities=(alike,)))
    )
    columns = np.arange(1, 6)
    at = model.regressor(table, model.nominal, columns, found.observations)
    T = np.delete(np.eye(5), 1, axis=1)
    T[1, 0] = 1.0
    B, y = at.B @ T, at.residual + at.B @ model.nominal[columns]
    z = np.linalg.solve(B.T @ B, B.T @ y)
    np.testing.assert_allclose(found.x[columns], T @ z, rtol=1e-8)
    e = y - B @ z
    free = identify(model, table, Options(method="ols"))
    covariance = free.sigma**2 * T @ np.linalg.inv(B.T @ B) @ T.T
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-6, atol=1e-24)
    assert found.dof == len(y) - 4
    assert found.sigma == pytest.approx(np.sqrt(e @ e / found.dof), rel=1e-9)
    told = found.finding("knowledge_contradicted").numbers["F"]
    assert told == pytest.approx(e @ e / free.sigma**2 - free.dof) and not found.verdict.trusted


def test_the_file_shown_in_the_documentation_is_read(tmp_path):
    (block,) = re.findall(r"```toml knowledge\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)
    path = tmp_path / "knowledge.toml"
    path.write_text(block, encoding="utf-8")
    known = read_knowledge(path)
    assert known.physical and known.prior is not None
    assert known.constraints.bounds and known.constraints.equalities and known.constraints.matrices


@pytest.mark.parametrize(
    "text, message",
    [
        ("prior = 3", "key prior takes tables by parameter"),
        ("[prior.joint2.compliance]\nmean = 1", r'in quotes: \[prior\."joint2\.compliance"\]'),
        ('[[bounds]]\nparameter = "a"', "state neither lower nor upper"),
        ('[[bounds]]\nparameter = "a"\nlower = 2\nupper = 1', "leave no value"),
        ("[[equality]]\nterms = { joint2.compliance = 1 }", "terms.joint2 .* with names in quotes"),
        ('[[semidefinite]]\nentries = [["a", "b"]]', "'matrix 1' is not square"),
        ('[[semidefinite]]\nlabel = "K"\nentries = [["a", "b"], ["c", "a"]]', "'K' is not symm"),
    ],
)
def test_a_wrong_file_is_told_by_file_and_key(tmp_path, text, message):
    path = tmp_path / "knowledge.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_knowledge(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    "stated, std",
    [('[prior."link5.ry"]\nmean = 0.0\nstd = 1e-3', 1e-3),
     ('[[equality]]\nterms = { "link5.ry" = 1.0 }', 0.0)],
)  # fmt: skip
def test_what_only_knowledge_holds_is_no_wider_than_known(tmp_path, stated, std):
    """Link 5 about y is joint 5's offset but in the second order; bounds cut what is widened."""
    path = tmp_path / "knowledge.toml"
    path.write_text(f'{stated}\n[[bounds]]\nparameter = "link3.rz"\nlower = -6e-4\n')
    found = ec.identify(WHOLE / "cell.toml", WHOLE / "data.csv", knowledge=path, method="ols")
    assert found["link5.ry"].std == pytest.approx(std, rel=1e-3)
    assert found["link5.dz"].std < 5e-4
    assert found["link3.rz"].ci95[0] == -6e-4
