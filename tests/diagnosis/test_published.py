"""The JSON of a diagnosis: complete, in the stated units, without numbers that JSON lacks."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED

from elastocal.diagnosis.diagnosis import Diagnosis, Gap, publish
from elastocal.identification.scrutiny import BudgetStep
from elastocal.model.manipulator import Model


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))


def test_every_part_of_the_result_is_published(model):
    """A field added to the result must not be forgotten here; one has another name, and the
    model and the fit behind the figures of the report are no part of the answer."""
    renamed = {"extra": "extra_plan"}
    names = {renamed.get(f.name, f.name) for f in fields(Diagnosis)} - {"calibrated", "model"}
    assert names <= set(publish(EXPLAINED, model, "data.csv"))


def test_what_is_not_known_is_null(model):
    unknown = replace(
        EXPLAINED,
        gap=Gap(math.nan, math.inf, 1e-5, 1e-5),
        budget=(BudgetStep("nominal", math.inf, (-math.inf, math.nan)),),
        location=None,
        noise=replace(EXPLAINED.noise, pure_error=None),
    )
    content = json.loads(json.dumps(publish(unknown, model, "data.csv"), allow_nan=False))
    assert content["gap"]["nominal_um"] is None and content["gap"]["calibrated_um"] is None
    assert content["budget"][0] == {"step": "nominal", "heldout_rms_um": None, "ci95": [None] * 2}
    assert content["location"] is None
    assert content["noise"]["pure_error_um"] is None
    assert content["noise"]["near_repeat_um"] is None and content["noise"]["near_repeats"] is None
    assert content["extra_plan"] is None
