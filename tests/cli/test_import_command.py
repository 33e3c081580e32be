"""elastocal import on the command line: what it writes, shows, refuses, and never does."""

import json
import re

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


def test_preview_shows_and_writes_nothing_without_output(campaign, tmp_path):
    before = sorted(tmp_path.iterdir())
    code, out, err = run("points.txt", "poses.dat", *PRESETS, "--preview", "--cell", "cell.toml")
    assert code == 0 and err == ""
    flat = " ".join(out.split())
    for text in (
        "20 rows of points (preset spatialanalyzer",
        "column 3 x_mm mm",
        "A6 q6_deg deg",
        "Not used: E1, E2",
        "20 readings of 10 configurations, 1 per configuration, marker and load",
        "Markers: M1, M2",
        "by name; by the numbers at the ends of the names (P01 is 1)",
        "Nominal arm: readings fit it to",
    ):
        assert text in flat, text
    assert sorted(tmp_path.iterdir()) == before


def test_json_tells_the_same(campaign):
    code, out, _ = run("points.txt", "poses.dat", *PRESETS, "--json", "-o", "data.csv")
    told = json.loads(out)
    assert code == 0
    assert told["schema"] == "elastocal/import/1"
    assert (told["readings"], told["configurations"], told["joined_by"]) == (20, 10, "name")
    assert told["files"][0]["columns"][0] == {
        "from": "column 1 + column 2",
        "to": "name",
        "unit": "",
    }


def test_what_is_left_out_is_said(campaign, tmp_path):
    text = (tmp_path / "poses.dat").read_text()
    (tmp_path / "poses.dat").write_text(re.sub(r"DECL E6AXIS XP10.*\n", "", text))
    (tmp_path / "map.toml").write_text('[join]\nunmatched = "leave_out"\n')
    code, out, err = run("points.txt", "poses.dat", *PRESETS, "--map", "map.toml", "-o", "d.csv")
    assert code == 0 and "wrote 18 readings of 9" in out
    assert "left out, without joint values: 2 points: P10::M1 (line 21), P10::M2 (line 22)" in err


def test_what_the_robot_cannot_have_measured_is_shown_and_not_written(campaign, tmp_path):
    (tmp_path / "map.toml").write_text("[joints]\noffset_deg = [0, 300, 0, 0, 0, 0]\n")
    code, out, err = run("points.txt", "poses.dat", *PRESETS, "--map", "map.toml", "--preview",
                         "--cell", "cell.toml", "-o", "d.csv")  # fmt: skip
    assert code == 2 and "joint2" in err and "beyond its limits" in err
    assert "offset_deg" in err and "Ranges" in out
    assert not (tmp_path / "d.csv").exists()


def test_presets_are_printed_to_be_copied(tmp_path):
    code, out, _ = run("--show-preset", "kuka")
    assert code == 0
    path = tmp_path / "mine.toml"
    # As it stands it is the body of a [[source]].
    text = re.sub(r"^\[(\w+)\]", r"[source.\1]", out, flags=re.MULTILINE)
    path.write_text("[[source]]\n" + text, encoding="utf-8")
    from elastocal.importing.mapping_file import read_mapping

    assert read_mapping(path).sources[0].role == "joints"
