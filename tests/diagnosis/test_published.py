"""The JSON of a diagnosis: complete, in the stated units, without numbers that JSON lacks."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED, MANY_UNKNOWN, VERDICTS

from elastocal.diagnosis import Diagnosis, Gap, NearRepeats, publish
from elastocal.identification import BudgetStep
from elastocal.model import Model


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))


@pytest.mark.parametrize("name", VERDICTS)
def test_what_is_written_reads_back_alike(name, model):
    content = publish(VERDICTS[name], model, "data.csv")
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_every_part_of_the_result_is_published(model):
    """A field added to the result must not be forgotten here; one has another name, and the
    model and the fit behind the figures of the report are no part of the answer."""
    renamed = {"extra": "extra_plan"}
    names = {renamed.get(f.name, f.name) for f in fields(Diagnosis)} - {"calibrated", "model"}
    assert names <= set(publish(EXPLAINED, model, "data.csv"))


def test_keys_and_units_of_the_design(model):
    content = publish(EXPLAINED, model, "data.csv")
    assert content["schema"] == "elastocal/diagnosis/1"
    assert content["verdict"] == "explained"
    assert content["gap"] == pytest.approx(
        {
            "nominal_um": 3200,
            "calibrated_um": 84,
            "explained_um": 21,
            "noise_floor_um": 19,
            "unexplained_um": 0,
        }
    )
    last = content["budget"][-2]
    assert last["step"] == "gear_eccentricity:joint2"
    assert [last["heldout_rms_um"], *last["ci95"]] == pytest.approx([21, 19, 23])
    (effect,) = content["effects"]
    assert (effect["effect"], effect["where"]) == ("gear_eccentricity", "joint2")
    assert effect["gap_reduction_ci95"] == [0.63, 0.84]
    first = effect["parameters"][0]
    low, high = first["ci95"]
    assert (first["unit"], (low + high) / 2) == ("rad", pytest.approx(1.12e-4))
    # 97.5 % of a normal distribution lie below 1.96 standard deviations.
    upper = (high - first["value"]) / first["std"]
    assert (1 + math.erf(upper / math.sqrt(2))) / 2 == pytest.approx(0.975, abs=1e-6)
    assert {"effect", "where", "probability", "score"} <= set(content["candidates"][0])
    assert content["location"]["evidence"]["stages"]["transmission"] == 0.984
    assert content["noise"]["faulty"][1]["error_um"] == pytest.approx(1300)
    assert [r["unit"] for r in content["noise"]["repeatability"]] == ["rad"] * 6


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


def test_near_repeats_and_what_is_unexplained_are_told(model):
    near = NearRepeats(26e-6, 12, 10, 20e-6)
    d = replace(
        EXPLAINED, noise=replace(EXPLAINED.noise, near_repeats=near),
        gap=replace(EXPLAINED.gap, unexplained=5e-5),
    )  # fmt: skip
    content = publish(d, model, "data.csv")
    assert content["gap"]["unexplained_um"] == pytest.approx(50.0)
    assert content["noise"]["near_repeat_um"] == pytest.approx(26.0)
    told = {"pairs": 12, "independent": 10, "soon_um": pytest.approx(20.0), "later_um": None}
    assert content["noise"]["near_repeats"] == told


def test_components_groups_and_fields(model):
    content = publish(MANY_UNKNOWN, model, "data.csv")
    first = content["components"][0]
    assert (first["family"], first["where"], first["effects"]) == (
        "angle", "joint2", ["joint_curve"],
    )  # fmt: skip
    assert first["effect"] == "joint_curve" and first["named"] is True
    assert first["share"] == 0.55 and first["share_ci90"] == pytest.approx([0.495, 0.605])
    rms = 426 * math.sqrt(0.55)
    assert first["rms_um"] == pytest.approx(rms)
    assert first["rms_ci95_um"] == pytest.approx([0.94 * rms, 1.06 * rms])
    assert content["components"][-1]["named"] is False
    gears = content["groups"][0]
    assert (gears["name"], gears["places"]) == ("gear_errors", ["joint1", "joint2", "joint5"])
    assert gears["effects"] == ["joint_curve", "gear_eccentricity"]
    assert (gears["share"], gears["share_ci90"]) == (0.82, [0.79, 0.85])
    assert (gears["gap_reduction"], gears["gap_reduction_ci90"]) == (0.54, [0.52, 0.56])
    (field,) = content["fields"]
    assert (field["effect"], field["where"]) == ("residual_field", "base")
    assert field["settings"]["field_time_length"] == 5400.0
    assert content["location"]["evidence"]["shares"] == {"transmission": 0.97, "tracker": 0.05}
    kinds = [f["kind"] for f in content["findings"]]
    assert kinds[:4] == [
        "unknown_effect", "many_causes", "named_beside_unknown", "corrected_without_a_name",
    ]  # fmt: skip
