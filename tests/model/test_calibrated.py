"""A result file is read back with its cell, or refused where it is of another kind or model."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

import elastocal as ec

CAMPAIGN = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"
SCHEMA = "elastocal/identification/1"


def test_markers_that_only_the_table_named_are_found_in_the_result(tmp_path: Path) -> None:
    text = (CAMPAIGN / "placed.toml").read_text(encoding="utf-8")
    text = re.sub(r"\[tool\.markers_m\]\n(M.*\n)+", "", text)
    cell, result = tmp_path / "cell.toml", tmp_path / "result.json"
    cell.write_text(text.replace('"arm.urdf"', f'"{CAMPAIGN / "arm.urdf"}"'), encoding="utf-8")
    held = {f"marker:{marker}.{axis}": 0.1 for marker in ("A", "B") for axis in "xyz"}
    held |= {n: 0.0 for n in ec.Model(cell).names if not n.startswith("marker")}
    entries = [{"name": name, "held": value} for name, value in held.items()]
    result.write_text(json.dumps({"schema": SCHEMA, "parameters": entries}))
    arm = ec.read_calibrated(cell, result)
    assert arm.values["marker:B.z"] == 0.1
    assert tuple(arm.model.cell.tool.markers) == ("A", "B")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda r: r.update(schema="elastocal/plan/1"), "schema is 'elastocal/plan/1'"),
        (lambda r: r["parameters"].pop(0), "the result lacks joint1.compliance"),
        (lambda r: r["parameters"].append(r["parameters"][0]), "is listed twice"),
        (lambda r: r["parameters"][2].update(held=None), "held .* no. 3 takes a number"),
        (lambda r: r["parameters"][2].update(held=float("nan")), "NaN is no number of JSON"),
        (lambda r: r["covariance_of"].pop(), "covariance of"),
    ],
)
def test_a_result_of_another_kind_or_model_is_refused(
    tmp_path: Path, change: Any, told: str
) -> None:
    result = json.loads((CAMPAIGN / "result.json").read_text(encoding="utf-8"))
    change(result)
    (tmp_path / "result.json").write_text(json.dumps(result))
    with pytest.raises(ec.InputError, match=told):
        ec.read_calibrated(CAMPAIGN / "deflecting.toml", tmp_path / "result.json")
