"""A compensator of any geometry: its starts, their profiles, and the cell that is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.cells import kr270_chain
from support.diagnoses import ECCENTRICITY
from support.diagnosis_data import FAULTS, campaign
from support.robots import KR270

from elastocal.cell.work_cell import read_cell
from elastocal.diagnosis.baseline import fit_baseline
from elastocal.diagnosis.diagnose import write_extended_cell
from elastocal.diagnosis.diagnosis import FittedParameter
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.hypotheses import Hypothesis, possible
from elastocal.diagnosis.model_set import Item, fit_extended, fit_set
from elastocal.model.manipulator import Model

VALUES = {
    "compensator_stiffness": 2.5e4, "compensator_anchor_x": 0.2, "compensator_anchor_y": -0.5,
    "compensator_arm": -0.3, "compensator_free_length": -0.4,
}  # fmt: skip


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
