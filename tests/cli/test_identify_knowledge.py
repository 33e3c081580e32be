"""`identify --knowledge` and `--physical` from the command line."""

import json

import numpy as np
import pytest
from support.calibration import measured, with_values
from support.cells import COMPLIANCE, SLANTED, TABLE_2, table_of
from support.robots import KR270
from typer.testing import CliRunner

from elastocal.cell.work_cell import read_cell
from elastocal.cli.main import app
from elastocal.model.manipulator import Model

CELL = f"""\
[robot]
urdf = "{KR270}"

[tool]
load_point_m = [0.20, 0.0, 0.25]

[tool.markers_m]
M1 = [0.25, 0.0, 0.0]
M2 = [-0.10, 0.20, 0.1118]
M3 = [-0.10, -0.20, 0.1118]

[model]
observe = "deflection"
effects = ["joint_compliance", "off_axis_compliance:joint2"]

[model.nominal]
joint_compliance = {list(COMPLIANCE)}
"""
BEARING = "joint2.off_axis_compliance_x"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A cell and deflections of an arm with rigid bearings: least squares makes one negative."""
    folder = tmp_path_factory.mktemp("campaign")
    cell = folder / "cell.toml"
    cell.write_text(CELL, encoding="utf-8")
    model = Model(read_cell(cell))
    truth = with_values(model, {"joint3.compliance": 5e-7})
    plan = table_of(TABLE_2, SLANTED, both=True)
    table = measured(model, plan, truth, 2e-4 / 2**0.5, np.random.default_rng(0))
    header = ["configuration", "marker", *(f"q{i + 1}_rad" for i in range(6))]
    header += [f"force_{a}_N" for a in "xyz"] + [f"{a}_m" for a in "xyz"]
    lines = [",".join(header)]
    for i in range(len(table)):
        numbers = [*table.q[i], *table.force[i], *table.position[i]]
        marker = table.marker_names[table.marker[i]]
        lines.append(
            ",".join([str(table.configuration[i]), marker, *map(repr, map(float, numbers))])
        )
    data = folder / "data.csv"
    data.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return cell, data


def run(campaign, *extra):
    """Exit code, stdout and stderr of `identify … -q` with further options."""
    arguments = ["identify", *map(str, campaign), "-q", *map(str, extra)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    return result.exit_code, result.stdout, result.stderr


def values(output):
    return {p["name"]: p for p in json.loads(output)["parameters"]}


def test_physical_holds_a_negative_compliance_at_zero(campaign):
    code, alone, _ = run(campaign, "--json")
    assert code == 0 and values(alone)[BEARING]["value"] is None
    assert values(alone)[BEARING]["limits95"][0] < 0
    code, found, _ = run(campaign, "--json", "--physical")
    assert code == 0
    told = json.loads(found)
    assert told["method"] == "constrained"
    assert [a["label"] for a in told["active"]] == [f"{BEARING} >= 0"]
    assert all(p["value"] >= 0 for p in told["parameters"])
    assert values(found)[BEARING]["identifiable"] and values(found)[BEARING]["ci95"][0] == 0


def test_file_and_flag_add_up(campaign, tmp_path):
    path = tmp_path / "known.toml"
    path.write_text('[prior."joint3.compliance"]\nmean = 4.2e-7\nstd = 1e-8\n', encoding="utf-8")
    code, found, _ = run(campaign, "--json", "--physical", "--knowledge", path)
    told = json.loads(found)
    assert code == 0 and told["active"]
    assert told["prior_share"]["joint3.compliance"] > 0.5
    path.write_text("physical = true\n", encoding="utf-8")
    _, by_file, _ = run(campaign, "--json", "--knowledge", path)
    _, by_flag, _ = run(campaign, "--json", "--physical")
    assert values(by_file) == values(by_flag)


def test_terminal_and_report_say_what_was_held(campaign, tmp_path):
    report = tmp_path / "report.html"
    code, shown, message = run(campaign, "--physical", "--report", report)
    assert code == 0, message
    assert "constraints" in shown and report.exists()


def test_bounded_is_still_there(campaign):
    code, found, _ = run(campaign, "--json", "--bounded")
    assert code == 0
    told = json.loads(found)
    assert told["method"] == "reml" and told["active"] == []
    assert values(found)[BEARING]["held"] == 0 and values(found)[BEARING]["value"] is None
