"""Which parameters the data determine, on arms whose redundancies are known by name."""

import numpy as np
import pytest
from scipy import linalg
from support.calibration import GEOMETRY, campaign, cell_of, planar_chain, random_chain, table_at
from support.cells import random_poses

from elastocal.cell_tables import Nominal
from elastocal.identification.identify import identify
from elastocal.identification.solve import reduce
from elastocal.model.effects.geometry import JointOffset
from elastocal.model.manipulator import Model

DOWN = ((0.0, 0.0, -300.0),)
SIDEWAYS = ((300.0, 0.0, 0.0),)


def reduced(chain, effects, forces=((0, 0, 0),), seed=0, **cell):
    """Structural reduction of the model at nominal values, with names: kept → {dropped: share}."""
    model = Model.assembled(chain, cell_of(effects, **cell))
    B = model.regressor(table_at(random_poses(chain, 30, seed), forces)).B
    found = reduce(B, model.sizes(B), model.parameters, 1.0, 0.0)
    share = {
        model.names[d]: {
            model.names[k]: round(float(found.mixing[i, j]), 9)
            for i, k in enumerate(found.kept)
            if abs(found.mixing[i, j]) > 1e-9
        }
        for j, d in enumerate(found.dropped)
    }
    return [model.names[k] for k in found.kept], share, [model.names[d] for d in found.invisible]


def test_a_rank_is_a_number_of_which_low_ones_are_kept_first(monkeypatch):
    """As the page on effects of one's own has it."""
    assert "joint1.offset" in reduced(planar_chain(), GEOMETRY)[1]
    monkeypatch.setattr(JointOffset, "rank", 0)
    assert "joint1.offset" not in reduced(planar_chain(), GEOMETRY)[1]


def test_a_vertical_joint_1_leaves_base_z_and_link1_dz_as_a_sum():
    kept, share, _ = reduced(planar_chain(), GEOMETRY)
    assert share["link1.dz"] == {"base.z": 1.0}
    assert share["joint1.offset"] == {"base.rz": 1.0}
    assert share["link3.dx"] == {"marker:M1.x": 1.0}
    assert {f"base.{k}" for k in ("x", "y", "z", "rx", "ry", "rz")} <= set(kept)
    assert {f"marker:M1.{k}" for k in "xyz"} <= set(kept)


@pytest.mark.parametrize("nominal", [None, Nominal(joint_compliance=(1e-5, 2e-5, 3e-5))])
def test_a_vertical_load_does_not_show_a_vertical_joint(nominal):
    model = {} if nominal is None else {"nominal": nominal}
    kept, share, invisible = reduced(planar_chain(), ("joint_compliance",), DOWN, **model)
    assert kept == ["joint2.compliance", "joint3.compliance"]
    assert share == {"joint1.compliance": {}} and invisible == ["joint1.compliance"]
    kept, share, invisible = reduced(planar_chain(), ("joint_compliance",), SIDEWAYS, **model)
    assert len(kept) == 3 and not share and not invisible


def test_no_interval_for_what_the_data_cannot_determine():
    """Two arms with the same readings may not differ in any parameter that is given a value.

    Such arms are truth + v with B v = 0; with every |v_d| up to its typical size, a parameter
    with an interval may move by less than its standard deviation.
    """
    model, table, _ = campaign(GEOMETRY, 25, chain=random_chain(0, 4))
    rng, result = np.random.default_rng(1), identify(model, table)
    B = model.regressor(result.observations.table, result.x).B
    sizes = model.sizes(B)
    _, singular, Vt = linalg.svd(B * sizes)
    rank = int((singular > 1e-9 * singular[0]).sum())
    null = Vt[rank:]
    assert len(null)
    for _ in range(20):
        v = null.T @ rng.normal(size=len(null))
        v /= np.abs(v).max()
        for e, moved in zip(result.estimates, v * sizes, strict=True):
            if e.identifiable:
                assert abs(moved) < e.std, e.name
    for e in result.estimates:
        numbers = (e.value, e.std, e.ci95)
        assert all(n is None for n in numbers) or not any(n is None for n in numbers)
        assert e.identifiable == (not e.combined_with and not e.note)
        if e.identifiable:
            assert e.value == e.held and e.ci95[0] < e.value < e.ci95[1]
            assert e.name in result.determined
