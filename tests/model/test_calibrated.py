"""A result file read back is the model that identification predicted with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from elastocal.demo.example import Demo, run_demo
from elastocal.errors import InputError
from elastocal.model.calibrated import read_calibrated


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    return run_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture
def written(demo: Demo, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    path = tmp_path / "result.json"
    result = demo.result.to_json()
    path.write_text(json.dumps(result))
    return path, result


def test_markers_that_only_the_table_named_are_found_in_the_result(
    demo: Demo, tmp_path: Path
) -> None:
    folder = demo.cell.parent
    text = demo.cell.read_text()
    lines = text.splitlines()
    start = lines.index("[tool.markers_m]")
    kept = [k for k, line in enumerate(lines) if k > start and line.startswith("[")]
    cell = folder / "without_markers.toml"
    shorter = [*lines[:start], *lines[kept[0] :]]
    cell.write_text(
        "\n".join(shorter).replace('"joint_compliance', '"marker_position", "joint_compliance', 1)
    )
    parameters = [
        {"name": f"marker:{marker}.{axis}", "held": 0.1} for marker in ("A", "B") for axis in "xyz"
    ]
    parameters += [{"name": e.name, "held": e.held} for e in demo.result.estimates]
    result = tmp_path / "result.json"
    result.write_text(
        json.dumps({"schema": "elastocal/identification/1", "parameters": parameters})
    )
    arm = read_calibrated(cell, result)
    assert arm.values["marker:B.z"] == 0.1
    assert tuple(arm.model.cell.tool.markers) == ("A", "B")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda r: r.update(schema="elastocal/plan/1"), "schema is 'elastocal/plan/1'"),
        (lambda r: r["parameters"].pop(0), "the result lacks joint1.compliance"),
        (lambda r: r["parameters"].append(r["parameters"][0]), "is listed twice"),
        (
            lambda r: r["parameters"][2].update(held=None),
            "held .* no. 3 takes a number",
        ),
        (lambda r: r["parameters"][2].update(held=float("nan")), "NaN is no number of JSON"),
        (lambda r: r["covariance_of"].pop(), "covariance of"),
    ],
)
def test_a_result_of_another_kind_or_model_is_refused(
    demo: Demo, written: tuple[Path, dict[str, Any]], change: Any, told: str
) -> None:
    path, result = written
    change(result)
    path.write_text(json.dumps(result))
    with pytest.raises(InputError, match=told):
        read_calibrated(demo.cell, path)
