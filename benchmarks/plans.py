"""Measurement plans: error, bound, CPU, of each effort, and how they grow.

    python benchmarks/plans.py [--beside SRC] [--efforts quick normal] [--only CELL …] [--growth]
                               [--rounding]

`--beside`: the source folder of another checkout, whose quick plans are made of the same cells.
`--rounding`: normal plans of the first of the cells, of its number of poses and of three times as
many: what of the distance to the bound goes with whole poses in place of weights.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from bench_tools import HERE, elastocal, goal, number, table

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
EFFICIENCY, QUICKER, BETTER = 0.99, 1.0, 0.02  # goals
EFFECTS = 'effects = ["base_frame", "joint_offset", "link_geometry", '
FEWER = 'effects = ["base_frame", '
MORE = f'{EFFECTS}"gear_eccentricity", "gear_second_harmonic", '


def cell_file(folder: Path, arm: str, rules: str) -> Path:
    path = folder / f"{arm or 'KR270'}{len(rules)}.toml"
    if not arm:
        text = (KR270 / "joint_limits.toml").read_text().replace("candidates = 20000", "")
        text = text.replace('"../../', f'"{HERE.parent}/')
        path.write_text(text.replace('"test_poses.csv"', f'"{KR270 / "test_poses.csv"}"'))
        return path
    package, ending, flange = ARMS[arm]
    files = metadata.distribution(package).files or ()
    urdf = next(Path(str(f.locate())) for f in files if str(f).endswith(ending))
    joints = 7 if arm in ("Panda", "iiwa14") else 6
    compliance = [3e-5, 3e-5, 5e-5, 5e-5, 1e-4, 1e-4, 1e-4][:joints]
    flange = f'flange = "{flange}"' if flange else ""
    path.write_text(CELL.format(urdf=urdf, flange=flange, compliance=compliance, rules=rules))
    return path


def planned(cell: Path, poses: int, effort: str, *options: Any, **environment: str) -> dict:
    """What plan.json says of a plan, and the CPU s of its command."""
    out = cell.with_name("plan.csv")
    at = () if cell.stem.startswith("KR270") else ("--poses", poses)
    ran = elastocal("design", cell, *at, "-o", out, "--effort", effort, "-q",
                    *options, **environment)  # fmt: skip
    return json.loads(out.with_suffix(".json").read_text()) | {"cpu": ran.cpu}


def figures(plan: dict) -> list[Any]:
    c = plan["certificate"]
    return [f"{plan['value']:.4g}", plan["cpu"], c["efficiency_pool"], c["efficiency_continuum"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beside", type=Path)
    parser.add_argument("--efforts", nargs="+", default=["quick", "normal"])
    parser.add_argument("--only", nargs="+", default=list(CELLS), choices=CELLS, metavar="CELL")
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--rounding", action="store_true")
    chosen = parser.parse_args()
    beside: dict[str, str] = {"PYTHONPATH": str(chosen.beside)} if chosen.beside else {}
    lower, ratios, shares = [], [], []
    with tempfile.TemporaryDirectory() as name:
        if chosen.rounding:
            arm, rules, poses, more = CELLS[chosen.only[0]]
            cell = cell_file(Path(name), arm, rules)
            plans = {n: planned(cell, n, "normal", *more) for n in (poses, 3 * poses)}
            heads = ["poses", "parameters", "ρ₀ µm", "CPU s", "of pool", "of continuum"]
            rows = [[n, len(plan["predicted"]), *figures(plan)] for n, plan in plans.items()]
            return table(f"Whole poses or weights: {chosen.only[0]}, normal", heads, rows)
        heads = ["cell", *(f"{e}: {what}" for e in chosen.efforts for what in
                           ("ρ₀ µm", "CPU s", "of pool", "of continuum"))]  # fmt: skip
        rows = []
        for title in chosen.only:
            arm, rules, poses, more = CELLS[title]
            cell = cell_file(Path(name), arm, rules)
            found = {e: planned(cell, poses, e, *more) for e in chosen.efforts}
            rows.append([title, *(f for plan in found.values() for f in figures(plan))])
            if "normal" in found and poses >= 20:
                shares.append(found["normal"]["certificate"]["efficiency_continuum"])
            if beside and "quick" in found:
                old = planned(cell, poses, "quick", *more, **beside)
                rows[-1] += [f"{old['value']:.4g}", old["cpu"]]
                ratios.append(found["quick"]["cpu"] / old["cpu"])
                lower.append(1 - found["quick"]["value"] / old["value"])
            print("  ".join(map(number, rows[-1])), flush=True)
        table("Plans", heads + ["beside: ρ₀ µm", "CPU s"] * bool(beside), rows)
        if shares:
            goal("efficiency on the continuum, normal", min(shares), EFFICIENCY, least=True)
        if ratios:
            goal("quick: CPU, of that beside", float(np.median(ratios)), QUICKER)
            goal("quick: lower ρ₀, median", float(np.median(lower)), BETTER, least=True)
        if chosen.growth:
            cell = cell_file(Path(name), "UR10", LIMITS)
            sizes = [("poses", n, ()) for n in (10, 20, 40, 80)]
            sizes += [("candidates", n, ("--candidates", n)) for n in (1000, 5000, 20_000)]
            rows = [
                [of, n, *figures(planned(cell, n if of == "poses" else 20, "quick", *more))]
                for of, n, more in sizes
            ]
            for effects in (FEWER, EFFECTS, MORE):
                other = cell.with_name("effects.toml")
                other.write_text(cell.read_text().replace(EFFECTS, effects))
                plan = planned(other, 20, "quick")
                rows.append(["parameters", len(plan["predicted"]), *figures(plan)])
            table("Growth, UR10, quick", ("of", "number", *heads[1:5]), rows)


if __name__ == "__main__":
    main()
