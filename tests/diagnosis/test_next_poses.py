"""The next poses from what was measured so far, and when no more are needed."""

import json
from pathlib import Path

import numpy as np
import pytest
from golden.door import curved
from support.design_commands import elastocal

import elastocal as ec
from elastocal.diagnosis.next_poses import verdict_of
from elastocal.planning.plan import Gain
from elastocal.simulation import run_demo

INPUTS = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"
FEW = ["--candidates", "60", "-q"]


def next_of(cell: Path, data: Path) -> dict:
    done = elastocal("next", cell, data, "-o", cell.parent / "n.csv", "--json", *FEW)
    return json.loads(done.output)


def test_measuring_ends_where_enough_is_kept_or_nothing_is_won() -> None:
    won, lost, first = (Gain(*v) for v in ((3, 2, 1, 1, 6), (3, 2.99, 1, 1, 6), (*[np.inf] * 5,)))
    assert verdict_of(won, 6, None, 0.01) == verdict_of(won, 6, 5, 0.01) == "measure"
    assert verdict_of(won, 5, 5, 0.01) == verdict_of(lost, 5, 5, 0.01) == "enough"
    assert verdict_of(lost, 6, 5, 0.01) == "no_gain" != verdict_of(first, np.inf, 5, 0.01)
    assert 3.8 < Gain.of(np.array([[0.0, 2.0]]), np.eye(1), np.eye(1), 0).sure < 4.05


@pytest.mark.long
def test_enough_is_said_and_no_plan_is_written(tmp_path) -> None:
    run_demo(tmp_path)
    cell, data, path = (tmp_path / name for name in ("cell.toml", "data.csv", "none.csv"))
    done = elastocal("next", cell, data, "-o", path, "--require", "new_poses=1000", *FEW)
    told = " ".join(done.output.split())
    assert done.exit_code == 0 and not path.exists() and "not written" in told
    assert "no further pose is needed: the required error is kept with 95 %" in told
    assert "(required: 1.00 mm)" in told


def test_what_no_pose_shows_is_held(tmp_path) -> None:
    """Distances alone do not say how the arm stands about its first joint."""
    (tmp_path / "arm.csv").write_bytes((INPUTS / "arm.csv").read_bytes())
    text = "[robot]\ndh = 'arm.csv'\n[tracker]\ndistance_um = 40\nanchor_m = [1.5, 0.5, 0.2]\n"
    text += "[tool.markers_m]\nM1 = [0.2, 0.1, 0.1]\nM2 = [-0.1, 0.2, 0.1]\n[model]\n"
    text += "observe = 'distance'\neffects = ['distance_sensor', 'joint_offset']\n"
    cell, data = tmp_path / "cell.toml", tmp_path / "data.csv"
    cell.write_text(text)
    assert elastocal("simulate", cell, INPUTS / "data.csv", "-o", data).exit_code == 0
    answer = next_of(cell, data)
    assert "no poses tell joint1.offset from the rest" in (told := answer["plan"]["warnings"][0])
    assert "--fix" not in told and len(answer["plan"]["warnings"]) == 1
    assert 0 < answer["gain"]["after"] < answer["gain"]["before"] < answer["reached"] < np.inf


@pytest.mark.long
def test_the_gain_counts_smooth_functions(tmp_path) -> None:
    for name in ("placed.toml", "arm.urdf"):
        (tmp_path / name).write_bytes((INPUTS / name).read_bytes())
    curved(tmp_path)
    cell, data, drawn = tmp_path / "curved.toml", tmp_path / "data.csv", ("--draw", 1)
    assert elastocal("simulate", cell, tmp_path / "turns.csv", "-o", data, *drawn).exit_code == 0
    answer = next_of(cell, data)
    assert answer["gain"]["before"] > 0.4 * answer["reached"]


def test_where_no_noise_is_stated_the_measurements_show_it(tmp_path) -> None:
    """A plan for a cell without [tracker] noise takes that of its readings, and says so."""
    for name in ("arm.csv", "links.csv"):
        (tmp_path / name).write_bytes((INPUTS / name).read_bytes())
    text = (INPUTS / "wished.toml").read_text().replace('"deflection"', '"position"')
    cell, data, plan = (tmp_path / name for name in ("cell.toml", "data.csv", "plan.csv"))
    cell.write_text(text.replace("sigma_um = 10", "sigma_um = 40"))
    assert elastocal("simulate", cell, INPUTS / "data.csv", "-o", data).exit_code == 0
    cell.write_text(text.replace("sigma_um = 10", ""))
    for words in (("next", cell, data), ("design", cell, "--augment", data, "--poses", 3)):
        answer = json.loads(elastocal(*words, "-o", plan, "--json", *FEW).output)
        (told,) = (w for w in answer.get("plan", answer)["warnings"] if "states no" in w)
        assert 30 < float(told.split("takes the ")[1].split()[0]) < 50, told
    cell.write_text(text + "[[design.test_pose]]\nq_deg = [0, 20, -60, 0, 40, 0]\n")
    shares = []
    for point in ("", "point_m = [0.6, 0.4, 0.9]\n"):  # away from the markers
        cell.write_text(cell.read_text() + point)
        fit, more = ec.identify(cell, data), ec.next_poses(cell, data, batch=2, candidates=60)
        assert more.calibration.verdict.at == fit.verdict.at  # both of the pose that is stated
        shares.append(more.gain.before / fit.predicted.parameters)
    assert 0.8 < shares[0] / shares[1] < 1.25  # the plan is judged where the fit is
