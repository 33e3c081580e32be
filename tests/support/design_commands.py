"""Small cells of the KR 270-2 to design plans for, and the command line to do it by."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from support.robots import KR270
from typer.testing import CliRunner, Result

from elastocal.__main__ import commands

# The command in a process: a child may inherit that SIGINT is ignored; here it must not.
PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from elastocal.__main__ import main; main()"
)
TEST_POSES = """
[[design.test_pose]]
q_deg = [0, -90, 90, 0, 30, 0]

[[design.test_pose]]
q_deg = [30, -60, 60, 20, 50, 10]
"""
BARE = f"""\
[robot]
urdf = "{KR270}"
[tool]
load_point_m = [0.20, 0.0, 0.25]
[tool.markers_m]
M1 = [0.25, 0.0, 0.05]
M2 = [-0.12, 0.22, 0.10]
M3 = [-0.05, -0.10, 0.25]
[tracker]
position_m = [3.0, 0.0, 1.0]
sigma_um = 10
[model]
observe = "deflection"
effects = ["joint_compliance"]
[model.nominal]
joint_compliance = [0.35e-6, 0.28e-6, 0.416e-6, 2.786e-6, 3.483e-6, 2.074e-6]
[design]
poses = 5
loads_N = [[0, 0, 0], [0, 0, -2600]]
candidates = 60
"""
DEFLECTION = BARE + TEST_POSES
POSITION = DEFLECTION.replace('"deflection"', '"position"').replace(
    '["joint_compliance"]', '["base_frame", "joint_offset", "joint_compliance", "marker_position"]'
)


def altered(cell: str, **keys: str) -> str:
    """The cell with KEY = TEXT in [design], instead of what it says there."""
    lines = [line for line in cell.splitlines() if line.split(" = ")[0] not in keys]
    at = lines.index("[design]") + 1
    return "\n".join([*lines[:at], *(f"{k} = {v}" for k, v in keys.items()), *lines[at:]]) + "\n"


def write_cell(folder: Path, text: str = DEFLECTION) -> Path:
    path = folder / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return path


def elastocal(*arguments: object, **environment: str) -> Result:
    """A command in this process; whatever is not a clean exit is an error of ours."""
    words = [str(a) for a in arguments]
    return CliRunner().invoke(commands(), words, env=environment, catch_exceptions=False)


def design(cell: Path, *extra: object, output: str = "plan.csv", quiet: bool = True) -> Result:
    how = ["--effort", "quick", *(["-q"] if quiet else [])]
    return elastocal("design", cell, "-o", cell.parent / output, *how, *extra)


def planned(cell: Path, *extra: object, output: str = "plan.csv") -> dict[str, Any]:
    result = design(cell, *extra, output=output)
    assert result.exit_code == 0, result.stderr
    return dict(json.loads((cell.parent / output).with_suffix(".json").read_text("utf-8")))


def everything_in(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))
