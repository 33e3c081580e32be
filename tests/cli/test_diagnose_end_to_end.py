"""The whole way: simulate an arm with an effect, diagnose it with a cell that lacks the effect."""

from __future__ import annotations

import json
import shutil

import pytest
from support.cells import KR270, TABLE_2
from typer.testing import CliRunner

from elastocal.cli.main import app

CELL = """\
[robot]
urdf = "arm.urdf"

[tool]
load_point_m = [0.20, 0.0, 0.25]

[tool.markers_m]
M1 = [0.25, 0.0, 0.0]
M2 = [-0.10, 0.20, 0.1118]
M3 = [-0.10, -0.20, 0.1118]

[tracker]
sigma_um = 15

[model]
effects = ["base_frame", "joint_offset", "joint_compliance", "marker_position"EFFECT]

[model.nominal]
joint_compliance = [3.5e-7, 2.87e-7, 4.16e-7, 2.786e-6, 3.483e-6, 2.074e-6]
"""


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    return result.stdout


@pytest.fixture
def measured(tmp_path):
    """Writes a cell without `effect` and readings of an arm that has it, at these values."""

    def write(effect="", **values):
        shutil.copyfile(KR270, tmp_path / "arm.urdf")
        cell, world = tmp_path / "cell.toml", tmp_path / "world.toml"
        cell.write_text(CELL.replace("EFFECT", ""), encoding="utf-8")
        world.write_text(CELL.replace("EFFECT", effect and f', "{effect}"'), encoding="utf-8")
        header = ",".join(f"q{i + 1}_rad" for i in range(6))
        rows = [",".join(map(repr, map(float, q))) for q in TABLE_2]
        (tmp_path / "plan.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
        set_values = [v for name, x in values.items() for v in ("--set", f"{name}={x}")]
        run("simulate", world, tmp_path / "plan.csv", "-o", tmp_path / "data.csv",
            "--load", 0, 0, -2600, "--seed", 3, *set_values)  # fmt: skip
        return cell, tmp_path / "data.csv"

    return write


def test_a_gear_that_runs_out_of_round_is_found_and_its_model_fits(measured, tmp_path):
    truth = {"joint4.harmonic2_sin": 3e-4, "joint4.harmonic2_cos": -2e-4}
    cell, data = measured("gear_second_harmonic:joint4", **truth)
    outputs = [tmp_path / name for name in ("d.json", "d.html", "new.toml")]
    run("diagnose", cell, data, "-q", "-o", outputs[0], "--report", outputs[1],
        "--cell-out", outputs[2])  # fmt: skip
    found = json.loads(outputs[0].read_text(encoding="utf-8"))
    named = [*found["effects"], *(e for rivals in found["indistinguishable"] for e in rivals)]
    assert found["verdict"] in ("explained", "ambiguous")
    assert ("gear_second_harmonic", "joint4") in {(e["effect"], e["where"]) for e in named}
    assert found["gap"]["explained_um"] < 0.7 * found["gap"]["calibrated_um"]
    assert {u["effect"] for u in found["untested"]} >= {"hysteresis", "joint_drift"}
    before = json.loads(run("identify", cell, data, "--json", "-q"))
    after = json.loads(run("identify", outputs[2], data, "--json", "-q"))
    assert after["heldout_rms_um"] < 0.7 * before["heldout_rms_um"]


def test_where_nothing_is_missing_nothing_is_claimed(measured):
    found = json.loads(run("diagnose", *measured(), "--json", "-q"))
    assert found["verdict"] == "nothing_significant"
    assert found["effects"] == []
