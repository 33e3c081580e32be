"""Every preset reads its style, and what it reads is what was measured, as docs show it."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.tracker_exports import (
    MARKERS,
    delimited,
    imported,
    kr270_readings,
    krl,
    rapid,
    spatialanalyzer,
)
from typer.testing import CliRunner

from elastocal.__main__ import commands
from elastocal.importing.exports import likely_presets
from elastocal.messages import InputError

PAGE = (Path(__file__).parents[2] / "docs" / "importing.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    return kr270_readings(tmp_path_factory.mktemp("cell"))


def holds(found, degrees, points):
    """The table has these joint values and points, in the order of the points."""
    q = np.repeat(degrees, points.shape[1], axis=0)
    np.testing.assert_allclose(np.degrees(found.table.q), q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.table.position * 1e3, points.reshape(-1, 3), atol=1e-9)
    names = [found.table.marker_names[m] for m in found.table.marker]
    assert names == list(MARKERS) * (len(names) // len(MARKERS))


@pytest.mark.parametrize(
    ("tracker", "export", "log"),
    [
        ("spatialanalyzer", spatialanalyzer, "abb"),
        ("polyworks", lambda p: delimited(p, "Name\tMeas X (mm)\tMeas Y (mm)\tMeas Z (mm)", "\t"),
         "kuka"),
        ("leica", lambda p: delimited(p, "Point ID;X [mm];Y [mm];Z [mm]", ";", ","), "abb"),
        ("faro", lambda p: delimited(p, "Feature,X (mm),Y (mm),Z (mm)"), "kuka"),
    ],
)  # fmt: skip
def test_tracker_and_controller(tmp_path, readings, tracker, export, log):
    cell, degrees, points = readings
    poses = krl(degrees) if log == "kuka" else rapid(degrees)
    files = {"points.txt": export(points), "poses.txt": poses}
    found = imported(tmp_path, files, presets=(tracker, log), cell=cell)
    holds(found, degrees, points)
    assert found.joined.how == "name"
    assert found.warnings == () and found.refused == ""
    assert found.fit.error < 1e-5


def test_joint_states_are_ordered_by_their_names(tmp_path, readings):
    cell, degrees, points = readings
    order = [2, 1, 0, 4, 3, 5]
    names = [f"joint_a{j + 1}" for j in order]
    head = ["%time", "field.header.stamp", *(f"field.name{i}" for i in range(6)),
            *(f"field.position{i}" for i in range(6))]  # fmt: skip
    rows = [
        ",".join(["1", str(10**18 + i), *names, *(f"{v:.12f}" for v in np.radians(q[order]))])
        for i, q in enumerate(degrees)
    ]
    mapping = """
[[source]]
preset = "spatialanalyzer"
files = ["points*"]
[[source]]
preset = "ros"
[joints]
names = ["joint_a1", "joint_a2", "joint_a3", "joint_a4", "joint_a5", "joint_a6"]
[join]
by = "order"
"""
    log = "\n".join([",".join(head), *rows])
    files = {"points.txt": spatialanalyzer(points), "joints.csv": log}
    holds(imported(tmp_path, files, mapping, cell=cell), degrees, points)


def test_the_unit_is_that_of_the_axes_comment_or_asked_for(tmp_path, readings):
    _, degrees, points = readings
    both = "spatialanalyzer", "kuka"
    files = {"p.txt": spatialanalyzer(points / 25.4, unit="in"), "j.dat": krl(degrees)}
    found = imported(tmp_path, files, presets=both)
    np.testing.assert_allclose(found.table.position * 1e3, points.reshape(-1, 3), atol=0.01)
    files["p.txt"] = files["p.txt"].replace("(in)", "")
    with pytest.raises(InputError, match=r"column 3.*no unit.*length_unit='mm'"):
        imported(tmp_path, files, presets=both)
    assert likely_presets(tmp_path / "p.txt") == ["spatialanalyzer"]


def test_the_preview_shown_is_what_is_printed(tmp_path, monkeypatch):
    (block,) = re.findall(r"```console\n\$ (elastocal import points.*?)```", PAGE, re.S)
    command, _, shown = block.replace("\\\n", " ").partition("\n")
    _, degrees, points = kr270_readings(tmp_path)
    (tmp_path / "points.txt").write_text(spatialanalyzer(points), encoding="utf-8")
    (tmp_path / "poses.dat").write_text(krl(degrees), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    result = CliRunner().invoke(commands(), command.split()[1:], catch_exceptions=False)
    assert result.exit_code == 0
    printed = [" ".join(line.split()) for line in result.stdout.splitlines()]
    for line in (" ".join(line.split()) for line in shown.splitlines()):
        if line and line != "..." and not line.startswith("Nominal arm"):
            assert line in printed


def test_the_mapping_shown_is_one_and_takes_the_files_it_names(tmp_path):
    (text,) = re.findall(r"```toml mapping\n(.*?)```", PAGE, re.S)
    with pytest.raises(InputError, match=r"mapping.toml: no file fits files = 'loaded\*.csv'"):
        imported(tmp_path, {"unloaded.txt": "", "poses.dat": ""}, text)


def test_a_joint_stated_by_itself_counts_before_that_of_the_preset(tmp_path, readings):
    _, degrees, points = readings
    axes = ", ".join(f'q{i + 1}_deg = "A{i}"' for i in range(1, 7))
    mapping = (
        '[[source]]\npreset = "spatialanalyzer"\nfiles = ["points.txt"]\n'
        f'[[source]]\npreset = "kuka"\ncolumns = {{ q1_mm = "E1", {axes} }}\n'
    )
    poses = krl(degrees).replace("E1 0.0", "E1 250.0")
    files = {"points.txt": spatialanalyzer(points), "poses.dat": poses}
    found = imported(tmp_path, files, mapping)
    assert found.table.kinds == ("prismatic", *("revolute",) * 6)
    q = np.repeat(degrees, points.shape[1], axis=0)
    np.testing.assert_allclose(found.table.q[:, 0], 0.25)
    np.testing.assert_allclose(np.degrees(found.table.q[:, 1:]), q, rtol=0, atol=1e-9)
