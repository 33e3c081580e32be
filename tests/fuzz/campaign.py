"""Small valid input for every verb: what the fuzzer spoils, one case at a time."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorial"
STUDY = ROOT / "tests" / "golden" / "inputs" / "campaign" / "study"
URDF = ROOT / "src" / "elastocal" / "demo" / "kr270_2.urdf"


@dataclass(frozen=True)
class Command:
    """A verb with valid arguments.

    Words of `line` that name a file of the campaign are inputs; `outputs` are what it writes;
    `named` are files that it reads although only another file names them.
    """

    verb: str
    line: str
    outputs: tuple[str, ...] = ()
    named: tuple[str, ...] = ()


# The arm that deflects (DH table), the arm that is placed (URDF), and a work cell to plan in.
DEFLECTING = """\
name = "six-axis arm"

[robot]
dh = "arm.csv"
masses = "links.csv"

[tool]
load_point_m = [0.25, 0.0, 0.10]

[tool.markers_m]
M1 = [0.25, 0.0, 0.05]
M2 = [-0.10, 0.20, 0.05]

[tracker]
sigma_um = 10

[model]
observe = "deflection"
effects = ["joint_compliance"]
deflection_model = "linear"

[model.nominal]
joint_compliance = [1.8e-6, 2.1e-6, 3.4e-6, 1.2e-5, 1.5e-5, 2.2e-5]
"""
DESIGN = """
[design]
loads_N = [[0, 0, 0], [0, 0, -98]]
prior = "typical"
"""
PLACED = """\
name = "KR 270"

[robot]
urdf = "arm.urdf"
base = "base_link"

[tool]
load_point_m = [0.20, 0.0, 0.25]

[tool.markers_m]
M1 = [0.2, 0.05, 0.1]
M2 = [-0.1, 0.15, 0.12]

[tracker]
position_m = [0.0, 0.0, 0.0]
range_um = 10
range_ppm = 0.3
transverse_um = 15
transverse_ppm = 6

[model]
observe = "position"
effects = ["base_frame", "joint_offset", "joint_compliance:joint2", "marker_position"]
gear_ripple_orders = [121]

[model.nominal]
joint_compliance = [3.5e-7, 2.9e-7, 4.2e-7, 2.8e-6, 3.5e-6, 2.1e-6]
base_position_m = [-3.2, -2.4, -0.9]
base_rpy_deg = [0.0, 0.0, 90.0]

[limits]
joint1_deg = [-185, 185]
"""
PLANNED = (
    DEFLECTING
    + """
[workspace]
link_radius_mm = [80, 70, 60, 50, 40, 30]
clearance_mm = 20
self_clearance_mm = 5
self_collision = true
ignored_pairs = [["link2", "link4"]]
torque_limits_Nm = [900, 900, 600, 150, 150, 80]

[[workspace.obstacle]]
name = "table"
shape = "box"
size_m = [1.2, 0.8, 0.2]
position_m = [1.6, 1.4, -0.55]
rpy_deg = [0, 0, 30]

[[workspace.obstacle]]
name = "fixture"
shape = "mesh"
file = "fixture.stl"
scale = 0.001
position_m = [3.6, 2.4, -0.9]

[[workspace.body]]
name = "spindle"
on = "flange"
shape = "cylinder"
radius_m = 0.03
length_m = 0.1
position_m = [0, 0, 0.1]

[[workspace.keep_out]]
name = "walkway"
point_m = [-5.5, 0, 0]
normal = [1, 0, 0]

[workspace.load]
shape = "cylinder"
radius_m = 0.05
length_m = 0.1
rope_m = 0.2
rope_radius_mm = 5
rope_axis = [0, 0, 1]
max_angle_deg = 179
min_height_m = -3.0

[workspace.visibility]
range_m = [0.0, 20]
beam_radius_mm = 5
line_of_sight = false

[design]
poses = 4
criterion = "test_pose"
repeats = 3
loads_N = [[0, 0, 0], [0, 0, -98]]
candidates = 40

[design.levels]
joint2_deg = [-30, 20, 60]

[[design.test_pose]]
q_deg = [0, 20, -20, 0, 40, 0]
load_N = [0, 0, -98]
weight = 2

[design.test_path]
file = "path.csv"

[design.motion]
home_deg = [0, 0, 0, 0, 30, 0]
speed_deg_per_s = 30
dwell_s = 30
load_change_s = 600
both_directions = false
"""
)
LINKS = "link,mass_kg,com_x_m,com_y_m,com_z_m\n" + "".join(
    f"{i},{12 - i},0.1,0.02,0.05\n" for i in range(1, 7)
)
PATH = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,weight\n10,20,-20,0,40,0,1\n30,40,-30,0,40,0,2\n"
STL = """\
solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 100 0 0
vertex 0 100 0
endloop
endfacet
facet normal 0 0 -1
outer loop
vertex 0 0 0
vertex 0 100 0
vertex 0 0 100
endloop
endfacet
endsolid s
"""
KNOWLEDGE = """\
[prior."joint2.compliance"]
mean = 2.1e-6
std = 3e-8

[[bounds]]
parameter = "joint3.compliance"
lower = 0.0
upper = 1e-5

[[equality]]
terms = { "joint4.compliance" = 1.0, "joint5.compliance" = -0.8 }
value = 0.0
label = "the wrist"

[[semidefinite]]
label = "wrist"
entries = [["joint5.compliance", 2e-8], [2e-8, "joint6.compliance"]]
"""
MAPPING = """\
[[source]]
files = ["points.txt"]
role = "points"
preset = "spatialanalyzer"

[[source]]
files = ["poses.dat"]
role = "joints"
preset = "kuka"
"""

COMMANDS = (
    Command("design", "wished.toml -o plan.csv --effort quick --candidates 30 --curve 3,4 "
            "--json -q --criterion A", ("plan.csv", "plan.json"), ("arm.csv", "links.csv")),
    Command("design", "wished.toml -o plan.csv --effort quick --poses 4 --candidates 40 "
            "--criterion D --augment data.csv --program robot.src --picture plan.svg",
            ("plan.csv", "plan.json", "robot.src", "plan.svg"), ("arm.csv", "links.csv")),
    Command("design", "planned.toml -o plan.csv --effort quick --knowledge knowledge.toml "
            "--program robot.script --report design.html --fix joint1.compliance",
            ("plan.csv", "plan.json", "robot.script", "design.html"),
            ("arm.csv", "links.csv", "path.csv", "fixture.stl")),
    Command("design", "wished.toml -o plan.csv --effort quick --poses 4 --candidates 40 "
            "--criterion robust --keep poses.csv:1,3 -q", ("plan.csv", "plan.json"),
            ("arm.csv", "links.csv", "poses.csv")),
    Command("next", "wished.toml data.csv -o next.csv --batch 2 --candidates 40 --require "
            "new_poses=50", ("next.csv", "next.json"), ("arm.csv", "links.csv")),
    Command("simulate", "deflecting.toml poses.csv -o out.csv --set joint2.compliance=2e-6 "
            "--truth truth.json --draw 0.1 --load 0 0 -98 --repeats 2 --seed 3",
            ("out.csv", "truth.json"), ("arm.csv", "links.csv")),
    Command("simulate", "placed.toml plan270.csv -o out.csv --no-noise --json",
            ("out.csv",), ("arm.urdf",)),
    Command("import", "points.txt poses.dat --map mapping.toml --cell placed.toml -o out.csv "
            "--preview", ("out.csv",), ("arm.urdf",)),
    Command("import", "points.txt poses.dat --preset spatialanalyzer --preset kuka -o out.csv "
            "--length-unit mm --angle-unit deg --json", ("out.csv",)),
    Command("identify", "deflecting.toml data.csv -o out.json --weights covariance "
            "--covariance noise.csv --fix joint1 --method wls --json -q "
            "--residuals out.csv", ("out.json", "out.csv"), ("arm.csv", "links.csv")),
    Command("identify", "deflecting.toml data.csv -o out.json --test data.csv --report out.html "
            "--residuals out.csv --knowledge knowledge.toml",
            ("out.json", "out.html", "out.csv"), ("arm.csv", "links.csv")),
    Command("identify", "placed.toml placed.csv -o out.json --method huber --outliers keep "
            "--test placed.csv --report out.html --certificate done.html --details",
            ("out.json", "out.html", "done.html"), ("arm.urdf",)),
    Command("identify", "placed.toml placed.csv --residuals out.csv --noise axis --bounded "
            "--physical --seed 4", ("out.csv",), ("arm.urdf",)),
    Command("diagnose", "deflecting.toml data.csv -o out.json --cell-out cell_out.toml -q",
            ("out.json", "cell_out.toml"), ("arm.csv", "links.csv")),
    Command("diagnose", "deflecting.toml data.csv -o out.json --report out.html --plan extra.csv "
            "--poses 3 --cell-out cell_out.toml --without backlash",
            ("out.json", "out.html", "cell_out.toml"), ("arm.csv", "links.csv")),
    Command("next", "deflecting.toml data.csv -o plan.csv --batch 3 --candidates 20 --json -q "
            "--require new_poses=0.01", ("plan.csv", "plan.json"), ("arm.csv", "links.csv")),
    Command("compensate", "deflecting.toml result.json targets.csv -o out.csv --frame base "
            "--partial", ("out.csv",), ("arm.csv", "links.csv")),
    Command("compensate", "placed.toml placed.json --target 1500,200,1200,0,90,0 --point M1 "
            "--near 0,-90,90,0,20,0 -o out.csv --json", ("out.csv",), ("arm.urdf",)),
    Command("compensate", "deflecting.toml result.json --table out.csv --grid 2,2,2,1,1,1",
            ("out.csv",), ("arm.csv", "links.csv")),
    Command("compensate", "deflecting.toml result.json --table out.csv --grid 2 "
            "--box 700,-100,600,800,100,700 --rotation 0,90,0", ("out.csv",),
            ("arm.csv", "links.csv")),
    *(Command("export", f"{cell} -o out{ending} --load 0 0 -98 --poses 20 {extra}",
              (f"out{ending}",), named)
      for cell, ending, extra, named in (
          ("placed.toml placed.json", ".urdf", "--base-frame --no-frames", ("arm.urdf",)),
          ("placed.toml placed.json", ".xml", "--time-s 10", ("arm.urdf",)),
          ("deflecting.toml result.json", ".csv", "--format mdh", ("arm.csv", "links.csv")),
          ("deflecting.toml result.json", ".yaml", "--temperature-c 21", ("arm.csv", "links.csv")),
          ("deflecting.toml result.json", ".json", "--json", ("arm.csv", "links.csv")),
      )),
    Command("init", "arm.urdf -o out.toml", ("out.toml",)),
    Command("init", "arm.csv -o out.toml --convention modified", ("out.toml",)),
    Command("effects", "placed.toml --json", (), ("arm.urdf",)),
    Command("compare", "placed.toml placed.json placed.json -o out.json --poses 20 -q "
            "--load 0 0 -98", ("out.json",), ("arm.urdf",)),
    Command("study", "study -o results --set replicates=3 -q --jobs 1", (),
            ("study/study.toml", "study/study.py")),
    Command("study", "study -o results --set scale=2.5 -q --jobs 1 --only 2 --seed 5", (),
            ("study/study.toml", "study/study.py")),
    Command("demo", "-o demo_out -q --seed 3", ()),
)  # fmt: skip


def write(folder: Path) -> None:
    """All files that COMMANDS read, in `folder`; the tables and results are the tool's own."""
    from support.tracker_exports import kr270_readings, krl, spatialanalyzer

    from elastocal import verbs
    from elastocal.cell.work_cell import read_cell
    from elastocal.model.manipulator import Model
    from elastocal.simulation.simulate import expand_plan, simulate

    shutil.copytree(STUDY, folder / "study", ignore=shutil.ignore_patterns("__pycache__"))
    _, degrees, points = kr270_readings(folder)
    for name, text in (
        ("deflecting.toml", DEFLECTING), ("placed.toml", PLACED), ("planned.toml", PLANNED),
        ("wished.toml", DEFLECTING + DESIGN),
        ("links.csv", LINKS), ("path.csv", PATH), ("fixture.stl", STL),
        ("knowledge.toml", KNOWLEDGE), ("mapping.toml", MAPPING),
        ("points.txt", spatialanalyzer(points)), ("poses.dat", krl(degrees)),
    ):  # fmt: skip
        (folder / name).write_text(text, encoding="utf-8")
    for name in ("arm.csv", "poses.csv", "targets.csv"):
        shutil.copyfile(TUTORIAL / name, folder / name)
    shutil.copyfile(URDF, folder / "arm.urdf")
    header = ["configuration", *(f"q{i}_deg" for i in range(1, 7))]
    placed = [[i, *row] for i, row in enumerate(degrees, 1)]
    rows = [header, *placed]
    text = "\n".join(",".join(map(str, row)) for row in rows) + "\n"
    (folder / "plan270.csv").write_text(text, encoding="utf-8")
    # What identify, diagnose, compensate and export begin with.
    for cell, plan, data, result, load in (
        ("deflecting.toml", "poses.csv", "data.csv", "result.json", [0.0, 0.0, -98.0]),
        ("placed.toml", "plan270.csv", "placed.csv", "placed.json", [0.0, 0.0, -1000.0]),
    ):
        from elastocal.measurements import read_plan, write_measurements

        known = read_cell(folder / cell)
        model = Model(known)
        kinds = model.chain.kinds
        wanted = expand_plan(
            read_plan(folder / plan, joint_kinds=kinds),
            tuple(known.tool.markers), 2 if data == "data.csv" else 1, np.array(load),
        )  # fmt: skip
        write_measurements(simulate(model, wanted, model.nominal, 7), folder / data)
        fit = verbs.identify(folder / cell, folder / data)
        (folder / result).write_text(json.dumps(fit.to_json(), indent=1), encoding="utf-8")
    n = 3 * len(fit_rows(folder))
    text = "\n".join(",".join("1e-10" if i == k else "0" for k in range(n)) for i in range(n))
    (folder / "noise.csv").write_text(text + "\n", encoding="utf-8")


def fit_rows(folder: Path) -> list[str]:
    """Loaded rows of data.csv, which are those that a deflection is read from."""
    lines = (folder / "data.csv").read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("force_z_N")
    return [line for line in lines[1:] if float(line.split(",")[column])]
