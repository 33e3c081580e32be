"""Payloads and links that weigh something else than the model says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cells import LOAD_POINT, kr270_cell, kr270_chain, random_table

from elastocal.cell.arm_description import Tool
from elastocal.model import LinkMass, Model
from elastocal.model.effects import CATALOGUE

CHAIN = kr270_chain()
TABLE = random_table(CHAIN, 6, seed=4)
ELASTIC = ["joint_compliance"]


def disturbed(m: Model, values: dict[str, float]) -> np.ndarray:
    x = m.nominal
    for name, value in values.items():
        x[m.names.index(name)] = value
    return m.predict(TABLE, x)


def test_a_payload_factor_is_a_factor_of_the_force() -> None:
    m = Model.assembled(CHAIN, kr270_cell([*ELASTIC, "payload_error"]))
    heavier = replace(TABLE, force=1.1 * TABLE.force)
    expected = Model.assembled(CHAIN, kr270_cell(ELASTIC)).predict(heavier)
    found = disturbed(m, {"load.payload_scale": 0.1})
    np.testing.assert_allclose(found, expected, atol=1e-14)
    assert np.abs(found - m.predict(TABLE)).max() > 1e-4


def test_a_hook_elsewhere_is_another_load_point() -> None:
    m = Model.assembled(CHAIN, kr270_cell([*ELASTIC, "payload_error"]))
    cell = kr270_cell(ELASTIC)
    shift = np.array([0.05, -0.1, 0.2])
    tool = Tool(LOAD_POINT + shift, cell.tool.markers)
    expected = Model.assembled(CHAIN, replace(cell, tool=tool)).predict(
        replace(TABLE, force=0.9 * TABLE.force)
    )
    values = {f"load.load_point_{k}": v for k, v in zip("xyz", shift, strict=True)}
    found = disturbed(m, values | {"load.payload_scale": -0.1})
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_a_mass_error_is_another_mass_and_centre_of_mass() -> None:
    m = Model.assembled(CHAIN, kr270_cell([*ELASTIC, "link_mass_error:link3"], link_gravity=True))
    body = CHAIN.masses[2]
    other = LinkMass(body.mass + 30.0, body.com + np.array([0.05, -0.1, 0.08]))
    masses = (*CHAIN.masses[:2], other, *CHAIN.masses[3:])
    expected = Model.assembled(
        replace(CHAIN, masses=masses), kr270_cell(ELASTIC, link_gravity=True)
    ).predict(TABLE)
    moment = other.mass * other.com - body.mass * body.com
    values = {f"link3.moment_{k}": v for k, v in zip("xyz", moment, strict=True)}
    found = disturbed(m, values | {"link3.mass_error": 30.0})
    np.testing.assert_allclose(found, expected, atol=1e-14)
    assert np.abs(found - m.predict(TABLE)).max() > 1e-5


@pytest.mark.parametrize("weighed, share", [(True, 0.1), (False, 1.0)])
def test_a_typical_mass_error_is_a_tenth_of_the_mass_or_all_of_it(
    weighed: bool, share: float
) -> None:
    cell = kr270_cell(link_gravity=weighed)
    for i, body in enumerate(CHAIN.masses):
        mass, *moments = CATALOGUE["link_mass_error"].parameters(f"link{i + 1}", CHAIN, cell)
        assert mass.typical == pytest.approx(share * body.mass)
        offset = share * np.linalg.norm(body.com) + 0.02
        assert [m.typical for m in moments] == pytest.approx([body.mass * offset] * 3)
