"""elastocal import on the command line: what it writes, shows, refuses, and never does."""

import json

import numpy as np
import pytest
from support.tracker_exports import kr270_readings, krl, spatialanalyzer
from typer.testing import CliRunner

from elastocal.cli.main import app
from elastocal.measurements import read_measurements


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    """points.txt, poses.dat, cell.toml in the working directory; the joint values and points."""
    _, degrees, points = kr270_readings(tmp_path)
    (tmp_path / "points.txt").write_text(spatialanalyzer(points), encoding="utf-8")
    (tmp_path / "poses.dat").write_text(krl(degrees), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return degrees, points


PRESETS = ("--preset", "spatialanalyzer", "--preset", "kuka")


def run(*arguments):
    result = CliRunner().invoke(app, ["import", *map(str, arguments)], catch_exceptions=False)
    return result.exit_code, result.stdout, result.stderr


def test_what_it_writes_is_what_identify_reads(campaign, tmp_path):
    code, out, err = run(
        "points.txt", "poses.dat", *PRESETS, "-o", "data.csv", "--cell", "cell.toml"
    )
    assert code == 0, err
    assert out == "wrote 20 readings of 10 configurations to data.csv\n"
    table = read_measurements(tmp_path / "data.csv", joint_kinds=("revolute",) * 6)
    np.testing.assert_allclose(
        table.position.reshape(campaign[1].shape) * 1e3, campaign[1], atol=1e-9
    )
    result = CliRunner().invoke(app, ["identify", "cell.toml", "data.csv", "--quiet", "--json"])
    assert json.loads(result.stdout)["residual_rms_um"] < 1.0


def test_what_the_robot_cannot_have_measured_is_shown_and_not_written(campaign, tmp_path):
    (tmp_path / "map.toml").write_text("[joints]\noffset_deg = [0, 300, 0, 0, 0, 0]\n")
    code, out, err = run("points.txt", "poses.dat", *PRESETS, "--map", "map.toml", "--preview",
                         "--cell", "cell.toml", "-o", "d.csv")  # fmt: skip
    assert code == 2 and "joint2" in err and "beyond its limits" in err
    assert "offset_deg" in err and "Ranges" in out
    assert not (tmp_path / "d.csv").exists()
