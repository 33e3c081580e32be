"""The JSON of a diagnosis has no numbers that JSON lacks."""

from __future__ import annotations

import json
import math
from dataclasses import replace

from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED

from elastocal.diagnosis.diagnosis import Gap
from elastocal.identification.scrutiny import BudgetStep
from elastocal.model.manipulator import Model


def test_what_is_not_known_is_null():
    model = Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))
    (effect,) = EXPLAINED.effects
    unknown = replace(
        EXPLAINED,
        effects=(replace(effect, parameters=(replace(effect.parameters[0], std=math.inf),)),),
        gap=Gap(math.nan, math.inf, 1e-5, 1e-5),
        budget=(BudgetStep("nominal", math.inf, (-math.inf, math.nan)),),
        location=None,
        noise=replace(EXPLAINED.noise, pure_error=None),
    )
    content = json.loads(json.dumps(replace(unknown, model=model).to_json(), allow_nan=False))
    assert content["gap"]["nominal_um"] is None and content["gap"]["calibrated_um"] is None
    assert content["budget"][0] == {"step": "nominal", "heldout_rms_um": None, "ci95": [None] * 2}
    assert content["location"] is None
    (told,) = content["effects"][0]["parameters"]
    assert told["value"] is None and told["std"] is None and told["ci95"] is None
    assert content["noise"]["pure_error_um"] is None
    assert content["noise"]["near_repeat_um"] is None and content["noise"]["near_repeats"] is None
    assert content["extra_plan"] is None
