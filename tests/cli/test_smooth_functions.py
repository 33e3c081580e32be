"""Smooth functions from the command line: simulate, identify, compensate, export, design."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from fuzz import campaign
from golden.door import curved
from support.design_commands import elastocal
from typer.testing import Result

from elastocal.model.manipulator import Model, smooth_groups


def run(*words: object) -> Result:
    done = elastocal(*words, COLUMNS="200")
    assert done.exit_code == 0, done.output
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell, readings of an arm with curves drawn at random, and its calibration."""
    here = tmp_path_factory.mktemp("curved")
    campaign.write(here)
    curved(here)
    cell, data = here / "curved.toml", here / "data.csv"
    cell.write_text(cell.read_text().replace('"link_weights", ', ""))
    truth = ("--draw", 1, "--truth", here / "truth.json", "--seed", 1)
    run("simulate", cell, here / "turns.csv", "-o", data, *truth)
    run("identify", cell, data, "-o", here / "result.json")
    return here


def test_compensate_says_where_no_reading_shows_them(folder: Path) -> None:
    (folder / "far.csv").write_text(
        "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad\n"
        "0.5,-1.0,1.0,0.1,0.5,0.1\n2.5,-1.0,1.0,0.1,0.5,0.1\n"
    )
    out = folder / "far_commands.csv"
    done = run(
        "compensate", folder / "curved.toml", folder / "result.json", folder / "far.csv", "-o", out
    )
    assert "joint1 stands outside -85.9° to 85.9°" in done.output
    near, far = (float(row["std_um"]) for row in csv.DictReader(out.open()))
    assert far > 2 * near


def test_export_writes_them_as_corrections(folder: Path) -> None:
    out = folder / "corrections.csv"
    done = run(
        "export", folder / "curved.toml", folder / "result.json", "-o", out, "--format",
        "corrections", "--poses", 20,
    )  # fmt: skip
    assert "joint curve" in done.output
    assert "Determined mostly by a prior: joint1.offset" in " ".join(done.output.split())
    lines = out.read_text().splitlines()
    assert lines[0].startswith("# calibrated by elastocal")
    rows = list(csv.DictReader(lines[1:]))
    assert {row["where"] for row in rows} == {"joint1", "joint2"}
    own = [row for row in rows if row["where"] == "joint2"]
    assert float(own[0]["position_deg"]) == pytest.approx(np.degrees(-1.8), abs=1e-3)
    assert float(own[-1]["position_deg"]) == pytest.approx(np.degrees(-0.4), abs=1e-3)
    # Beside the truth, less what offsets stand for.
    truth = json.loads((folder / "truth.json").read_text())
    model = Model(folder / "curved.toml")
    group = smooth_groups(model)[1]
    x = np.radians([float(row["position_deg"]) for row in own])
    true = group.waves.at(x) @ [truth[model.names[c]] for c in group.columns[0]] * 1e6
    found = np.array([float(row["value"]) for row in own])
    half = np.array([float(row["half95"]) for row in own])
    assert (np.abs(found - true) < 1.5 * half).mean() > 0.9
    assert all(row["unit"] == "urad" for row in rows)


def test_compare_takes_a_curve_as_one_and_leaves_out_one_that_a_session_does_not_show(folder):
    cell, other = folder / "curved.toml", folder / "other.json"
    truth = json.loads((folder / "truth.json").read_text())
    truth["joint1.curve_1"] += 4e-4
    sets = (f"--set={name}={value!r}" for name, value in truth.items())
    run("simulate", cell, folder / "turns.csv", "-o", folder / "other.csv", "--seed", 2, *sets)
    run("identify", cell, folder / "other.csv", "-o", other)
    words = ("compare", cell, folder / "result.json", other, "--json")
    (one,) = (part for part in json.loads(run(*words).stdout)["parameters"] if part["changed"])
    assert one["name"] == "joint curve of joint1" and one["change"] == one["moves"] > 1e-4
    content = json.loads(other.read_text())
    del content["open"]
    names = content["covariance_of"]
    kept = [k for k, name in enumerate(names) if not name.startswith("joint1.curve")]
    content["covariance"] = np.array(content["covariance"])[np.ix_(kept, kept)].tolist()
    content["covariance_of"] = [names[k] for k in kept]
    other.write_text(json.dumps(content))
    (left,) = json.loads(run(*words).stdout)["not_compared"]
    assert left == "joint curve of joint1 (one session alone shows it)"
