"""Small valid input for every verb: what the fuzzer spoils, one case at a time."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from golden.door import equal_noise

INPUTS = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"
IGNORED = shutil.ignore_patterns("__pycache__", "june*")


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
            "--criterion G --keep poses.csv:1,3 -q", ("plan.csv", "plan.json"),
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
    shutil.copytree(INPUTS, folder, ignore=IGNORED, dirs_exist_ok=True)
    equal_noise(folder)
