"""Loads in a wrong unit or with a wrong sign leave no trace in the residual, but in compliances."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.robots import KR270

import elastocal as ec

CELL = """\
[robot]
urdf = "arm.urdf"
[tool]
load_point_m = [0.2, 0, 0.2]
[tool.markers_m]
M1 = [0.2, 0.05, 0.1]
M2 = [-0.1, 0.2, 0.1]
[tracker]
sigma_um = 15
[model]
effects = ["base_frame", "marker_position", "joint_compliance:joint2",
           "joint_compliance:joint3", "joint_compliance:joint4", "joint_compliance:joint5",
           "joint_compliance:joint6"]
"""
TRUE = {"joint2": 3e-7, "joint3": 4e-7, "joint4": 3e-6, "joint5": 3.3e-6, "joint6": 2.4e-6}
VALUES = {f"{joint}.compliance": k for joint, k in TRUE.items()}
G = 9.80665


@pytest.fixture(scope="module")
def made(request, tmp_path_factory) -> tuple[Path, ec.Measurements]:
    folder = tmp_path_factory.mktemp("loads")
    urdf = KR270.read_text(encoding="utf-8")
    if hasattr(request, "param"):
        urdf = re.sub(r'<mass value="[^"]*"', request.param, urdf)
    (folder / "arm.urdf").write_text(urdf, encoding="utf-8")
    path = folder / "cell.toml"
    path.write_text(CELL, encoding="utf-8")
    q = np.random.default_rng(1).uniform(-1, 1, (15, 6)) * [2, 0.5, 0.5, 2, 1.5, 2]
    q += [0, -1.2, 1.4, 0, 0, 0]
    return path, ec.simulate(path, q, values=VALUES, load=(0, 0, -2000.0), seed=3)


def fitted(made: tuple[Path, ec.Measurements], factor: float) -> ec.Calibration:
    path, table = made
    return ec.identify(path, replace(table, force=table.force * factor))


# The true masses of the links, and 2 kg for every link, as many a robot's file states.
@pytest.mark.parametrize("made", [r"\g<0>", '<mass value="2"'], indirect=True)
def test_the_unit_of_the_loads_is_named_with_its_direction(made):
    for factor in (1.0, 2.9):  # 0.28 times what the links' weights let expect is no unit
        assert fitted(made, factor).finding("load_unit") is None
    for factor, larger, mistake, undo in (
        (1 / G, True, "kilograms", "multiply force_x_N"),
        (1e-3, True, "kilonewtons", "by 1000"),
        (G, False, "newtons times 9.81", "divide force_x_N"),
    ):
        found = (fit := fitted(made, factor)).finding("load_unit")
        assert (found.number("ratio") > 1) == larger
        assert mistake in found.remedy and undo in found.remedy
        assert found.remedy in "\n".join(fit.warnings)


def test_a_load_in_the_opposite_direction_is_named_and_not_trusted(made):
    """No spring is negative by many standard deviations, and nothing is hardly shown there."""
    (path, table), fit = made, fitted(made, -1.0)
    verdict = fit.to_json()["verdict"]
    assert verdict["tone"] == "poor" and fit.finding("hardly_shown") is None
    said = "do not use this calibration: impossible values: compliance of joints 2, 3, 4, 5 and 6"
    assert said in verdict["doubt"]
    assert "most likely the sign of the force columns is wrong" in verdict["sentence"]
    fit.save(result := path.with_name("turned.json"))
    for arm in (fit.arm, ec.read_calibrated(path, result)):  # who uses it is told so
        commands = ec.compensate(arm, [[1.8, 0.0, 0.9]], load=(0, 0, -2000))
        arm.save(file := path.with_name("turned.urdf"))
        changes = " ".join(str(ec.compare(arm, arm)).split())
        assert all(said in text for text in (commands.warnings[0], file.read_text(), changes))
        assert "Use the new" not in changes
    why = ec.diagnose(path, replace(table, force=-table.force))
    assert "which no spring is: do not use this model. Check the sign" in why.warnings[0]
    told = " ".join(str(fit).split())
    assert "Check the sign of the force columns: where z points up, force_z_N" in told
    assert "Beyond a physical bound, so without a value (95 %): joint2.compliance (-0.3" in told
    assert "hardly shown" not in told.lower() and "fit with bounds" not in told
    assert "kilograms" not in told
    both = " ".join(str(fitted(made, -1 / G)).split())
    assert both.count("Check the sign of the force columns") == 1
    assert both.count("kilograms. If so, multiply force_x_N, force_y_N and force_z_N by 9.81") == 1


def test_a_single_negative_compliance_calls_for_care(made):
    path, _ = made
    q = np.random.default_rng(1).uniform(-1, 1, (15, 6)) + np.array([0, -1.2, 1.4, 0, 0, 0])
    values = VALUES | {"joint4.compliance": -3e-6}
    fit = ec.identify(path, ec.simulate(path, q, values=values, load=(0, 0, -2000.0), seed=3))
    assert fit.finding("impossible_values").numbers["parameters"] == ("joint4.compliance",)
    assert fit.verdict.tone == "care" and "most likely" not in fit.to_json()["verdict"]["sentence"]
    assert "or fit with bounds" in fit.finding("impossible_values").remedy


def test_a_marker_without_readings_is_named(made):
    path, table = made
    fit = ec.identify(path, table.take(np.flatnonzero(table.marker == 0)))
    told = " ".join(str(fit).split())
    none = f"no reading of marker M2 itself in {fit.observations.table.source}"
    assert f"There is {none}: measure it, or delete it from" in told
    assert "marker:M2.x" not in "".join(fit.left.redundant)
    assert f"({none}): marker:M2.x, marker:M2.y, marker:M2.z" in told
