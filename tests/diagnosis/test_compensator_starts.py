"""A compensator of any geometry: its starts, their profiles, and the cell that is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import ECCENTRICITY
from support.diagnosis_data import FAULTS, campaign
from support.robots import KR270

from elastocal.cell.work_cell import read_cell
from elastocal.diagnosis import (
    Hypothesis,
    Item,
    compute_columns,
    diagnosis_data_of,
    fit_baseline,
    fit_extended,
    fit_set,
    possible,
    write_extended_cell,
)
from elastocal.diagnosis.diagnosis import FittedParameter
from elastocal.diagnosis.hypotheses import StartSearch
from elastocal.model import Model
from elastocal.model.effects import CATALOGUE

SPRING = CATALOGUE["gravity_compensator"]
VALUES = {
    "compensator_stiffness": 2.5e4, "compensator_anchor_x": 0.2, "compensator_anchor_y": -0.5,
    "compensator_arm": -0.3, "compensator_free_length": -0.4,
}  # fmt: skip


def test_starts_turn_the_anchor_and_pull_push_and_keep_the_force() -> None:
    starts = SPRING.starts("joint2", kr270_chain(), kr270_cell())
    anchor = np.array([[s["compensator_anchor_x"], s["compensator_anchor_y"]] for s in starts])
    a, arm, free = (
        np.linalg.norm(anchor, axis=1),
        *(np.array([s[f"compensator_{key}"] for s in starts]) for key in ("arm", "free_length")),
    )
    assert len({round(t, 6) for t in np.arctan2(*anchor.T)}) == 24
    assert ((free < a - arm) & (free > 0)).any() and (free > a + arm).any()
    assert (np.abs(free) > 3 * (a + arm)).any() and (free < 0).any()
    assert ((a >= 0.1) & (a <= 0.5)).all() and (arm < a).all()


def test_a_stated_geometry_is_the_only_start() -> None:
    stated = kr270_cell()
    nominal = replace(stated.model.nominal, gravity_compensator={"joint": "joint2"})
    cell = replace(stated, model=replace(stated.model, nominal=nominal))
    assert SPRING.starts("joint2", kr270_chain(), cell) == ()


@pytest.fixture(scope="module")
def search() -> StartSearch:
    model, table = campaign("gear_eccentricity:joint2")
    base = fit_baseline(model, table)
    hypotheses = [h for h in possible(model, table)[0] if h.name == "gravity_compensator"]
    columns = compute_columns(base, hypotheses)
    return StartSearch.of(columns.full, hypotheses[0], base, columns.x, columns.rows)


def test_a_profile_times_the_factor_of_its_row_is_the_column_of_the_whole_model(
    search: StartSearch,
) -> None:
    for start in (search.starts[77], search.starts[400]):
        _, whole = search._amplitude(start, search.part.table)
        profile = SPRING.profiles("joint2", [start], search.part.table.q)
        fast = search._factor * profile
        assert np.abs(fast - whole).max() < 2e-3 * np.abs(whole).max()


def test_what_many_starts_explain_by_chance_is_paid_for(search: StartSearch) -> None:
    assert search.screened is not None
    best, share = search.screened
    assert -np.log(len(search.starts)) <= share < 0
    assert len(best) == 12
    left = [t.left for t in search.tangents()]
    assert left[0] <= min(left) + 1e-6


def test_a_model_without_parameters_has_starts_too() -> None:
    model, table = campaign("gear_eccentricity:joint2")
    bare = Model(replace(model.cell, model=replace(model.cell.model, effects=())))
    base = fit_baseline(bare, table)
    h = next(h for h in possible(bare, table)[0] if h.name == "gravity_compensator")
    columns = compute_columns(base, [h])
    assert StartSearch.of(columns.full, h, base, columns.x, columns.rows).X.shape[1] == 0


def test_from_the_start_that_was_found_the_exact_fit_ends_at_the_noise() -> None:
    """As if it had begun at the truth: the linear estimate is about that start."""
    name = "gravity_compensator:joint2"
    model, table = campaign(name)
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    (h,) = (h for h in dataset.hypotheses if h.name == "gravity_compensator")
    assert isinstance(h, Hypothesis)
    chosen = fit_set(dataset, (Item(h, np.zeros(0), 0.0),))
    found = fit_extended(dataset, chosen, chosen.items)
    true = dict(zip(base.model.names, base.x, strict=True))
    true |= {f"joint2.{key}": value for key, value in FAULTS[name].values.items()}
    x0 = np.array([true.get(p.name, p.nominal) for p in found.model.parameters])
    best = fit_baseline(found.model, table, x0=x0)
    assert found.residual.std() < 1.02 * best.residual.std() < 0.9 * base.residual.std()


def test_the_written_cell_begins_where_the_spring_was_found(tmp_path: Path) -> None:
    """From the example's geometry a fit would not find it again."""
    (tmp_path / "cell.toml").write_text(f'[robot]\nurdf = "{KR270}"\n', encoding="utf-8")
    fitted = tuple(FittedParameter(f"joint2.{k}", v, "m", 0.0) for k, v in VALUES.items())
    found = replace(
        ECCENTRICITY, effect="gravity_compensator", where="joint2", parameters=fitted, settings={}
    )
    write_extended_cell(tmp_path / "cell.toml", tmp_path / "new.toml", [found])
    cell = read_cell(tmp_path / "new.toml")
    spring = Model.assembled(kr270_chain(), cell)
    at = dict(zip(spring.names, spring.nominal, strict=True))
    # The other end of the arm is the same spring, anchored on the other side.
    assert at["joint2.compensator_arm"] == 0.3 and at["joint2.compensator_anchor_y"] == 0.5
    assert at["joint2.compensator_free_length"] == -0.4
    assert at["joint2.compensator_stiffness"] == 2.5e4
