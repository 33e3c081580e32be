"""`elastocal export` from the command line: formats, what is told, what is refused."""

from __future__ import annotations

from pathlib import Path

from support.exports import GEOMETRY, write_result
from support.mjcf_text import LOADABLE, write_arm
from support.urdf_text import arm
from typer.testing import CliRunner, Result

from elastocal.cli.main import app

FIXED = '<joint name="fj" type="fixed"><parent link="l5"/><child link="f"/></joint>'


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)], env={"COLUMNS": "200"})


def test_the_meshes_of_a_urdf_are_found_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "hull.stl").write_bytes(b"")
    shapes = [f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
              for name in ("hull.stl", "package://p/hull.stl")]  # fmt: skip
    text = arm(5, f'<link name="f">{"".join(shapes)}</link>' + FIXED)
    (tmp_path / "arm.urdf").write_text(text)
    written = write_result(tmp_path, 'urdf = "arm.urdf"\nflange = "l5"', GEOMETRY)
    (tmp_path / "out").mkdir()
    done = run(*written, "-o", tmp_path / "out" / "new.urdf", "-q", "--poses", "5")
    assert done.exit_code == 0 and "named relative to the file" in done.output, done.output
    found = (tmp_path / "out" / "new.urdf").read_text()
    assert 'filename="../hull.stl"' in found and 'filename="package://p/hull.stl"' in found


def test_a_urdf_of_a_mujoco_arm_has_its_masses_and_says_what_it_lacks(tmp_path: Path) -> None:
    write_arm(tmp_path, LOADABLE)
    written = write_result(tmp_path, 'mjcf = "arm.xml"\nbase = "foot"', GEOMETRY)
    done = run(*written, "-o", tmp_path / "new.urdf", "-q", "--poses", "5")
    assert done.exit_code == 0 and "inertia tensors are zero in this file" in done.output
    assert '<mass value="6.0"/>' in (tmp_path / "new.urdf").read_text()
