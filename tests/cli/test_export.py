"""`elastocal export` from the command line: formats, what is told, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.exports import GEOMETRY, SPRINGS, write_result
from support.robots import KR270
from support.urdf_text import arm
from typer.testing import CliRunner, Result

from elastocal.cli.main import app


@pytest.fixture
def campaign(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "arm.urdf").write_bytes(KR270.read_bytes())
    return write_result(tmp_path, 'urdf = "arm.urdf"', SPRINGS)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)], env={"COLUMNS": "200"})


@pytest.mark.parametrize(
    ("name", "starts"),
    [
        ("a.urdf", "<?xml"),
        ("a.xml", "<mujoco"),
        ("a.mjcf", "<mujoco"),
        ("a.csv", "# calibrated by elastocal"),
        ("a.yaml", "schema: "),
        ("a.JSON", "{"),
    ],
)
def test_the_ending_tells_the_format(campaign, tmp_path: Path, name: str, starts: str) -> None:
    output = tmp_path / name
    result = run(*campaign, "-o", output, "-q", "--poses", "10", "--load", 0, 0, -200)
    assert result.exit_code == 0, result.output
    assert output.read_text(encoding="utf-8").startswith(starts)
    assert f"wrote {output}" in result.output
    if name not in ("a.xml", "a.mjcf"):
        assert "joint compliance" in result.output and "(0, 0, -200) N" in result.output
        assert "Next: where that much matters, elastocal compensate" in result.output
    else:
        assert "The MJCF holds all of the calibrated model." in result.output
        assert "Next:" not in result.output
        assert "[model] link_gravity" in result.output  # no markup swallows it


def test_the_format_may_be_named(campaign, tmp_path: Path) -> None:
    output = tmp_path / "table.txt"
    result = run(*campaign, "-o", output, "--format", "MDH", "-q", "--poses", "10")
    assert result.exit_code == 0 and "modified convention" in output.read_text()


def test_json_says_what_the_terminal_says(campaign, tmp_path: Path) -> None:
    output = tmp_path / "a.urdf"
    options = ("--json", "-q", "--poses", "10", "--load", 0, 0, -200)
    result = run(*campaign, "-o", output, *options)
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert told["schema"] == "elastocal/export/1" and told["format"] == "urdf"
    assert told["output"] == str(output) and output.exists()
    assert told["read_back"]["with"] == "pinocchio" and told["read_back"]["max_um"] < 1e-3
    (entry,) = told["cannot_hold"]["effects"]
    assert entry["effect"] == "joint_compliance"
    assert entry["difference"]["marker_max_um"] >= entry["difference"]["marker_rms_um"] > 1
    assert told["cannot_hold"]["force_N"] == [0, 0, -200]


def test_held_values_are_named(campaign, tmp_path: Path) -> None:
    cell, path = campaign
    content = json.loads(path.read_text())
    content["parameters"][9]["identifiable"] = False
    path.write_text(json.dumps(content))
    result = run(cell, path, "-o", tmp_path / "a.urdf", "-q", "--poses", "10")
    assert "Held, as the data do not determine them" in result.output
    assert content["parameters"][9]["name"] in result.output


def test_a_mimic_beside_the_chain_stays_and_one_on_it_is_refused(tmp_path: Path) -> None:
    finger = (
        '<link name="f"/><joint name="grip" type="prismatic"><parent link="l5"/><child link="f"/>'
        '<limit lower="0" upper="1" effort="1" velocity="1"/><mimic joint="q5" multiplier="2"/>'
        "</joint>"
    )
    (tmp_path / "arm.urdf").write_text(arm(5, finger))
    written = write_result(tmp_path, 'urdf = "arm.urdf"\nflange = "l5"', GEOMETRY)
    output = tmp_path / "out.urdf"
    assert run(*written, "-o", output, "-q", "--poses", "5").exit_code == 0
    assert '<mimic joint="q5" multiplier="2"/>' in output.read_text()
    on_chain = {
        '<joint name="q5" type="revolute">': '<joint name="q5" type="revolute"><mimic joint="q4"/>'
    }
    (tmp_path / "arm.urdf").write_text(arm(5, finger, on_chain))
    result = run(*written, "-o", tmp_path / "again.urdf", "-q")
    assert result.exit_code == 2 and "mimics 'q4'" in result.output
    assert not (tmp_path / "again.urdf").exists()


def test_it_is_the_result_of_identify_that_is_exported(tmp_path: Path) -> None:
    """From the demo's readings to a file, by the commands alone."""
    from elastocal.demo.example import run_demo

    demo = run_demo(tmp_path)
    path = tmp_path / "result.json"
    path.write_text(json.dumps(demo.result.to_json()))
    output = tmp_path / "calibrated.xml"
    options = ("--json", "-q", "--poses", "20", "--load", 0, 0, -2600)
    result = run(demo.cell, path, "-o", output, *options)
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["held"] == {"joint1.compliance": 0.0}
    k = next(e.held for e in demo.result.estimates if e.name == "joint4.compliance")
    assert f'kp="{1 / k!r}"' in output.read_text()
    assert told["read_back"]["max_um"] < 1
