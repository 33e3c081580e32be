"""Measurement plans: error, bound, CPU, of each effort, and how they grow.

    python benchmarks/plans.py [--beside SRC] [--efforts quick normal] [--only CELL …]
                               [--poses N …] [--growth]

`--beside`: the source folder of another checkout, whose quick plans are made of the same cells.
`--poses`: these numbers in place of a cell's own; what of the distance to the bound goes with more
poses is that they are whole, and no weights.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench_tools import HERE, elastocal, goal, number, packaged, table

KR270 = HERE.parent / "experiment_design" / "kr270_plan"
ARMS = {
    "UR10": ("example-robot-data", "ur_description/urdf/ur10_robot.urdf", "tool0"),
    "Panda": ("example-robot-data", "panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "IRB140": ("rtb-data", "abb_irb140_description/urdf/irb140.urdf", ""),
    "iiwa14": ("rtb-data", "kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf", ""),
}
CELL = """
[robot]
urdf = "{urdf}"
{flange}
[tool]
load_point_m = [0.0, 0.0, 0.1]
[tool.markers_m]
M1 = [0.08, 0.0, 0.05]
M2 = [-0.06, 0.07, 0.06]
M3 = [-0.05, -0.08, 0.07]
[tracker]
position_m = [2.5, -1.5, 1.0]
sigma_um = 15
[model]
effects = ["base_frame", "joint_offset", "link_geometry", "joint_compliance", "marker_position"]
[model.nominal]
joint_compliance = {compliance}
[workspace]
{rules}
[design]
loads_N = [[0, 0, 0], [0, 0, -80]]
repeats = 3
"""
LIMITS = "mounting_plane = false"
RULES = """
link_radius_mm = 60
clearance_mm = 20
[[workspace.keep_out]]
name = "floor"
point_m = [0, 0, -0.05]
normal = [0, 0, 1]
[[workspace.obstacle]]
name = "post"
shape = "cylinder"
radius_m = 0.1
length_m = 2.0
position_m = [0.5, 0.5, 1.0]
[workspace.visibility]
range_m = [0.5, 6.0]
"""
# name → arm, rules, poses, further options; as in Table 2 of Klimchik et al. where there is no arm
CELLS: dict[str, tuple[str, str, int, tuple[str, ...]]] = {
    "KR 270 at levels": ("", "", 15, ()),
    "UR10, limits": ("UR10", LIMITS, 20, ()),
    "UR10, rules": ("UR10", RULES, 20, ()),
    "Panda, limits": ("Panda", LIMITS, 20, ()),
    "IRB 140, limits": ("IRB140", LIMITS, 20, ()),
    "iiwa 14, limits": ("iiwa14", LIMITS, 20, ()),
    "UR10, limits, 10 poses": ("UR10", LIMITS, 10, ()),
    "UR10, limits, D": ("UR10", LIMITS, 20, ("--criterion", "D")),
}
HEADS = ("ρ₀ µm", "CPU s", "of pool", "of continuum")
QUICKER, BETTER = 1.0, 0.02  # goals
EFFECTS = 'effects = ["base_frame", "joint_offset", "link_geometry", '
FEWER = 'effects = ["base_frame", '
MORE = f'{EFFECTS}"gear_eccentricity", "gear_second_harmonic", '


def planned(
    folder: Path, title: str, effort: str, *options: Any, poses: int = 0, effects: str = EFFECTS,
    **environment: str,
) -> dict:  # fmt: skip
    """What plan.json says of a plan in one of CELLS, and the CPU s of its command."""
    arm, rules, usual, more = CELLS[title]
    cell, out = folder / "cell.toml", folder / "plan.csv"
    if arm:
        package, ending, flange = ARMS[arm]
        compliance = [3e-5, 3e-5, 5e-5, 5e-5, 1e-4, 1e-4, 1e-4]
        text = CELL.format(
            urdf=packaged(package, ending), flange=f'flange = "{flange}"' if flange else "",
            compliance=compliance[: 7 if arm in ("Panda", "iiwa14") else 6], rules=rules,
        ).replace(EFFECTS, effects)  # fmt: skip
        more = ("--poses", poses or usual, *more)
    else:
        text = (KR270 / "joint_limits.toml").read_text().replace("candidates = 20000", "")
        text = text.replace('"../../', f'"{HERE.parent}/')
        text = text.replace('"test_poses.csv"', f'"{KR270 / "test_poses.csv"}"')
    cell.write_text(text)
    given = ("design", cell, "-o", out, "--effort", effort, "-q", *more, *options)
    ran = elastocal(*given, **environment)
    return json.loads(out.with_suffix(".json").read_text()) | {"cpu": ran.cpu}


def figures(plan: dict) -> list[Any]:
    """As HEADS."""
    c = plan["certificate"]
    return [f"{plan['value']:.4g}", plan["cpu"], c["efficiency_pool"], c["efficiency_continuum"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beside", type=Path)
    parser.add_argument("--efforts", nargs="+", default=["quick", "normal"])
    parser.add_argument("--only", nargs="+", default=list(CELLS), choices=CELLS, metavar="CELL")
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--poses", nargs="+", type=int, default=[0])
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        cells = [(title, poses) for title in chosen.only for poses in chosen.poses]
        compared(Path(name), cells, chosen.efforts, chosen.beside)
        if chosen.growth:
            growth(Path(name))


def compared(
    folder: Path, cells: list[tuple[str, int]], efforts: list[str], source: Path | None
) -> None:
    lower, ratios, rows = [], [], []
    for title, poses in cells:
        found = {e: planned(folder, title, e, poses=poses) for e in efforts}
        name = f"{title}, {poses} poses" if poses else title
        rows.append([name, *(f for plan in found.values() for f in figures(plan))])
        if source and "quick" in found:
            old = planned(folder, title, "quick", poses=poses, PYTHONPATH=str(source))
            rows[-1] += figures(old)[:2]
            ratios.append(found["quick"]["cpu"] / old["cpu"])
            lower.append(1 - found["quick"]["value"] / old["value"])
        print("  ".join(map(number, rows[-1])), flush=True)
    heads = ["cell", *(f"{e}: {head}" for e in efforts for head in HEADS)]
    table("Plans", heads + ["beside: ρ₀ µm", "CPU s"] * bool(source), rows)
    if ratios:
        goal("quick: CPU, of that beside", float(np.median(ratios)), QUICKER)
        goal("quick: lower ρ₀, median", float(np.median(lower)), BETTER, least=True)


def growth(folder: Path) -> None:
    quick = partial(planned, folder, "UR10, limits", "quick")
    rows = [["poses", n, *figures(quick(poses=n))] for n in (10, 20, 40, 80)]
    for n in (1000, 5000, 20_000):
        rows.append(["candidates", n, *figures(quick("--candidates", n))])
    for effects in (FEWER, EFFECTS, MORE):
        plan = quick(effects=effects)
        rows.append(["parameters", len(plan["predicted"]), *figures(plan)])
    table("Growth, UR10, quick", ("of", "number", *(f"quick: {head}" for head in HEADS)), rows)


if __name__ == "__main__":
    main()
