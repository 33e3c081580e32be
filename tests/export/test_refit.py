"""An exported file is the best that its format can hold of the arm, and a joint correction gives a
simulator the rest."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from support.exports import write_result
from support.mjcf_text import LOADABLE, write_arm
from support.robots import KR270
from support.urdf_text import arm as urdf_arm
from typer.testing import CliRunner

import elastocal as ec
from elastocal.__main__ import commands
from elastocal.export.exportable import read_joint_correction
from elastocal.export.robot_files import MujocoRest

HELD = ("base_frame", "joint_offset", "link_geometry", "marker_position", "joint_compliance")
LACKED = (
    "base_compliance", "gear_eccentricity:joint2", "gear_eccentricity:joint3",
    "gear_eccentricity:joint5", "hysteresis:joint2", "hysteresis:joint3",
)  # fmt: skip
CELL = """\
[robot]
urdf = "arm.urdf"
[tool]
load_point_m = [0.1, 0.02, 0.2]
[tool.markers_m]
M1 = [0.1, 0.0, 0.1]
M2 = [0.0, 0.2, 0.05]
[tracker]
sigma_um = 30
[model]
effects = {effects}
"""
SIZES = {
    "joint_compliance": 5e-7, "base_compliance": 1e-7, "gear_eccentricity": 1.5e-4,
    "hysteresis": 5e-5,
}  # fmt: skip
LOW = np.array([-1.5, -1.8, 0.2, -2.0, -1.5, -2.0])
HIGH = np.array([1.5, -0.4, 2.0, 2.0, 1.5, 2.0])


def run(*words: object) -> str:
    done = CliRunner().invoke(commands(), [*map(str, words)], env={"COLUMNS": "400"})
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """full.json: the arm with all its effects; plain.json: with those that a file holds."""
    made = tmp_path_factory.mktemp("refit")
    (made / "arm.urdf").write_bytes(KR270.read_bytes())
    (made / "plain.toml").write_text(CELL.format(effects=json.dumps(HELD)))
    (made / "full.toml").write_text(CELL.format(effects=json.dumps((*HELD, *LACKED))))
    rng, truth = np.random.default_rng(4), []
    for p in ec.Model(made / "full.toml").parameters:
        size = SIZES.get(p.effect, 0.3 if p.effect == "base_frame" else 5e-4)
        drawn = rng.normal() * (0.0 if p.name.endswith("per_torque") else size)
        value = abs(drawn) if p.lower == 0.0 else p.nominal + drawn
        truth.append(f"--set={p.name}={value!r}")
    # Poses, every second one under a load, with the sides that the joints came from.
    heads = [*(f"q{k}_rad" for k in range(1, 7)), *(f"force_{a}_N" for a in "xyz"),
             *(f"approach_{k}" for k in range(1, 7))]  # fmt: skip
    for name, n, seed in (("train", 32, 1), ("test", 24, 2)):
        draw = np.random.default_rng(seed)
        rows = [
            [*draw.uniform(LOW, HIGH).tolist(), 0, 0, -1500 * (k % 2), *draw.choice([-1, 1], 6)]
            for k in range(n)
        ]
        poses, out = made / f"{name}_plan.csv", made / f"{name}.csv"
        poses.write_text("\n".join(",".join(map(str, row)) for row in [heads, *rows]) + "\n")
        run("simulate", made / "full.toml", poses, "-o", out, "--seed", seed, *truth)
    for name in ("plain", "full"):
        cell, data = made / f"{name}.toml", (made / "train.csv", "--test", made / "test.csv")
        run("identify", cell, *data, "-o", made / f"{name}.json", "-q")
    return made


def own_error(folder: Path) -> float:
    return float(json.loads((folder / "full.json").read_text())["test"]["rms_um"])


def error_in_mujoco(folder: Path, xml: str, correction: str = "") -> float:
    """µm rms at the poses kept back, of the file at rest, commanded as `correction` says."""
    arm = MujocoRest((folder / xml).read_text())
    command = read_joint_correction(folder / correction) if correction else lambda q, side: q
    far = []
    for row in csv.DictReader((folder / "test.csv").open()):
        q, side = (np.array([float(row[n.format(k + 1)]) for k in range(6)]) for n in
                   ("q{}_rad", "approach_{}"))  # fmt: skip
        force = np.array([float(row[f"force_{a}_N"]) for a in "xyz"])
        (found,) = arm.sites(command(q, side), force, [f"marker_{row['marker']}"])
        far.append(np.linalg.norm(found - [float(row[f"{a}_m"]) for a in "xyz"]))
    return float(np.sqrt(np.mean(np.square(far))) * 1e6)


def export(folder: Path, name: str, out: str, *more: object) -> dict:
    cell, result = folder / f"{name}.toml", folder / f"{name}.json"
    told = run("export", cell, result, "-o", folder / out, "-q", "--base-frame", "--json", *more)
    return dict(json.loads(told))


def test_the_file_of_the_diagnosed_arm_is_no_worse_than_one_without_a_diagnosis(folder):
    told = export(folder, "full", "full.xml")["refit"]
    export(folder, "plain", "plain.xml")
    found, plain = error_in_mujoco(folder, "full.xml"), error_in_mujoco(folder, "plain.xml")
    assert told["taken"] and found < plain
    assert ", under 0 to 1500 N" in (folder / "full.xml").read_text()
    # What is promised for other poses is found there, noise included.
    expected = np.hypot(told["marker_rms_after_um"], own_error(folder))
    assert found == pytest.approx(expected, rel=0.15)
    assert told["marker_rms_after_um"] < 0.5 * told["marker_rms_before_um"]
    assert told["marker_rms_before_um"] < told["marker_rms_nominal_um"]


def test_one_load_is_told_as_one(folder):
    content = json.loads((folder / "full.json").read_text())
    visits = content["measured_visits"]
    visits["force_N"] = [[0, 0, -1500]] * len(visits["q"])
    (folder / "loaded.json").write_text(json.dumps(content))
    (folder / "loaded.toml").write_text((folder / "full.toml").read_text())
    told = export(folder, "loaded", "loaded.urdf", "--load", 0, 0, -1500)
    text = (folder / "loaded.urdf").read_text()
    assert ", under 1500 N, with its base at xyz " in text
    assert f'xyz="{" ".join(map(str, told["tracker_to_base"]["xyz_m"]))}"' in text


def test_with_its_joint_correction_mujoco_does_as_well_as_elastocal(folder):
    (folder / "joints.csv").unlink(missing_ok=True)
    correction = ("--joint-correction", folder / "joints.csv")
    told = export(folder, "full", "corrected.xml", *correction)["refit"]
    found = error_in_mujoco(folder, "corrected.xml", "joints.csv")
    assert found < 1.2 * own_error(folder)
    assert told["taken"] and told["marker_rms_with_correction_um"] < 20
    # Without directions the hysteresis of the joints is left; an arm without has none in its file.
    assert error_in_mujoco(folder, "corrected.xml") > 3 * found
    export(folder, "plain", "a.urdf", *correction)
    assert "joint2,joint3" in (text := correction[1].read_text()) and "approach" not in text


@pytest.mark.parametrize(
    ("out", "option", "told"),
    [
        ("a.yaml", "--joint-correction", "goes with urdf, mjcf, dh"),
        ("b.xml", "--joint-correction", "identify anew"),
        ("a.csv", "--base-frame", "--base-frame goes with urdf, mjcf; found format dh"),
    ],
)
def test_what_a_format_cannot_take_is_refused(folder, out, option, told):
    cell, result = folder / "full.toml", folder / "full.json"
    if told == "identify anew":
        content = json.loads(result.read_text())
        del content["measured_visits"]
        result = folder / "older.json"
        result.write_text(json.dumps(content))
    more = [folder / "c.csv"] if option == "--joint-correction" else []
    words = ["export", cell, result, "-o", folder / out, option, *more]
    done = CliRunner().invoke(commands(), [*map(str, words)], env={"COLUMNS": "400"})
    assert done.exit_code == 2 and told in done.output
    assert not (folder / out).exists() and not (folder / "c.csv").exists()


@pytest.mark.parametrize(
    ("text", "told"),
    [("a,b\n1,2\n", "its columns"), ("joint,follows,position,delta\nj,joint2,0,x\n", "row 2")],
)
def test_what_is_no_joint_correction_is_refused(tmp_path, text, told):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(ec.InputError, match=told):
        read_joint_correction(tmp_path / "c.csv")


# What a file written elsewhere or in another format says

FIXED = '<joint name="fj" type="fixed"><parent link="l5"/><child link="f"/></joint>'


def test_the_meshes_of_a_urdf_are_found_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "hull.stl").write_bytes(b"")
    shapes = [f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
              for name in ("hull.stl", "package://p/hull.stl")]  # fmt: skip
    text = urdf_arm(5, f'<link name="f">{"".join(shapes)}</link>' + FIXED)
    (tmp_path / "arm.urdf").write_text(text)
    written = write_result(tmp_path, 'urdf = "arm.urdf"\nflange = "l5"', HELD[:-1])
    (tmp_path / "out").mkdir()
    out = run("export", *written, "-o", tmp_path / "out" / "new.urdf", "-q", "--poses", "5")
    assert "named relative to the file" in out
    found = (tmp_path / "out" / "new.urdf").read_text()
    assert 'filename="../hull.stl"' in found and 'filename="package://p/hull.stl"' in found


def test_a_urdf_of_a_mujoco_arm_has_its_masses_and_says_what_it_lacks(tmp_path: Path) -> None:
    write_arm(tmp_path, LOADABLE)
    written = write_result(tmp_path, 'mjcf = "arm.xml"\nbase = "foot"', HELD[:-1])
    out = run("export", *written, "-o", tmp_path / "new.urdf", "-q", "--poses", "5")
    assert "inertia tensors are zero in this file" in out
    assert '<mass value="6.0"/>' in (tmp_path / "new.urdf").read_text()
