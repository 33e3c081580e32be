"""elastocal compensate from files to files, and what it says to wrong input."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from support.design_commands import elastocal
from support.robots import KR270

from elastocal.model.manipulator import Model

CELL = f"""
[robot]
urdf = "{KR270}"
[tool]
load_point_m = [0.2, 0.0, 0.25]
[tool.markers_m]
M1 = [0.25, 0.0, 0.0]
"[bold]M2" = [-0.1, 0.2, 0.1]
[model]
effects = ["joint_offset", "joint_compliance", "move_lag:joint2", "residual_field:base"]
[model.nominal]
settings.base.field_joint1_size = 1e-4
[limits]
joint1_deg = [-100, 100]
"""
TRUTH = {"joint2.offset": 1e-3, "joint5.offset": -8e-4, "joint2.compliance": 2.9e-7,
         "joint3.compliance": 4.2e-7, "joint5.compliance": 3.5e-6,
         "joint2.move_lag": 1e-4, "base.field_joint1_1_1": 1e-4}  # fmt: skip
TARGETS = """x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,force_x_N,force_y_N,force_z_N
1800,300,1500,0,120,0,0,0,-2600
1810,300,1500,0,120,0,0,0,-2600
1820,300,1500,0,120,0,0,0,-2600
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "cell.toml").write_text(CELL)
    (tmp_path / "targets.csv").write_text(TARGETS)
    held = {p.name: p.nominal for p in Model(tmp_path / "cell.toml").parameters} | TRUTH
    entries = [{"name": name, "held": float(value)} for name, value in held.items()]
    result = {
        "schema": "elastocal/identification/1",
        "parameters": entries,
        "covariance_of": list(TRUTH),
        "covariance": (1e-16 * np.eye(len(TRUTH))).tolist(),
    }
    (tmp_path / "result.json").write_text(json.dumps(result))
    return tmp_path


def run(folder, *arguments):
    files = (folder / "cell.toml", folder / "result.json")
    outcome = elastocal("compensate", *files, *arguments, "-q")
    assert "Traceback" not in outcome.stderr
    return outcome


def test_the_marker_named_is_where_simulate_sees_it(folder):
    out, seen = folder / "commands.csv", folder / "s.csv"
    outcome = run(folder, folder / "targets.csv", "-o", out, "--point", "[bold]M2")
    assert outcome.exit_code == 0, outcome.stderr
    told = " ".join(outcome.stdout.split())  # a marker's name is no markup
    assert "3 of 3 targets reached by the marker [bold]M2" in told
    assert "Next: Run commands.csv and measure some. 95 % of the targets" in told
    sets = [v for name, value in TRUTH.items() for v in ("--set", f"{name}={value}")]
    elastocal("simulate", folder / "cell.toml", out, "-o", seen, "--no-noise", *sets)
    rows = csv.DictReader(seen.read_text().splitlines())
    x = [float(row["x_m"]) for row in rows if row["marker"] == "[bold]M2"]
    assert np.allclose(x, [1.8, 1.81, 1.82], atol=1e-7)


def test_a_table_of_corrections_says_what_commands_say_of_loads(folder):
    words = ["--table", folder / "t.csv", "--grid", "1", "--json"]
    bent, found = CELL + "joint5_deg = [30, 60]\n", []
    tilted = bent.replace("[limits]", "base_rpy_deg = [0, 90, 0]\n[limits]")
    for cell, *load in ((bent,), (bent, 0, 0, -2600), (tilted, -2600, 0, 0, "--frame", "tracker")):
        (folder / "cell.toml").write_text(cell)
        told = json.loads(run(folder, *words, *["--load"][: len(load)], *load).stdout)["table"]
        assert any("no load is stated" in text for text in told["warnings"]) == (not load)
        row = (folder / "t.csv").read_text().splitlines()[1].split(",")
        found.append([float(v) for v in row[6:12]])
    # The base's own field is along the tracker's axes, 0.1 mm.
    assert np.allclose(found[1], found[2], atol=0.11) and abs(found[0][2] - found[1][2]) > 1


def test_targets_in_another_unit_are_told_so(folder):
    """1.8 mm from the base's origin no tool works; 1.8 m from it one does."""
    metres = TARGETS.replace("1800,300,1500", "1.8,0.3,1.5").replace("1810,300", "1.81,0.3")
    metres = metres.replace("1820,300", "1.82,0.3").replace(",1500,", ",1.5,")
    (folder / "targets.csv").write_text(metres)
    for words in (("--target", "1.8,0.3,1.5"), ("--target=1.8,0.3,1.5,0,120,0",),
                  (str(folder / "targets.csv"),),
                  ("--table", str(folder / "t.csv"), "--grid", "2", "--box", "1.7,-.1,.6,1.8,.1,1"),
                  ("--target", "3.8,0.3,1.5", "--frame", "tracker")):  # fmt: skip
        done = run(folder, *words)
        assert done.exit_code == 2, words
        assert "wrong unit?" in done.stderr and "in m where mm are asked for" in done.stderr
        assert not (folder / "t.csv").exists()
    (folder / "targets.csv").write_text(TARGETS.replace("_mm", "_m"))
    done = run(folder, str(folder / "targets.csv"), "-o", str(folder / "out.csv"))
    assert done.exit_code == 2 and "in mm where m are asked for" in done.stderr
    # What is near the origin and would be nowhere in another unit is taken as it is.
    done = run(folder, "--target", "20,3,9")
    assert "wrong unit" not in done.stderr
