"""A table of bad inputs: what is spoilt, the command, and (in expected/) its whole message.

Every one has to end with exit code 1 or 2, one message that names file, row, key or option, and
nothing written.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

CAMPAIGN = ("tests/golden/inputs/campaign",)
FIT = "identify placed.toml placed.csv -q -o out.json"
DEFLECT = "identify deflecting.toml data.csv -q -o out.json"
COMPENSATE = "compensate deflecting.toml result.json -q"
EXPORT = "export placed.toml placed.json -q"
POINTS = "--preset spatialanalyzer"
NEXT = "next wished.toml data.csv -o next.csv -q"
DESIGN = "design wished.toml -o plan.csv --candidates 20 --effort quick -q"


@dataclass(frozen=True)
class Mistake:
    """`command` where in `file` the first `old` is `new` (old empty: the whole text)."""

    name: str
    command: str
    file: str = ""
    old: str = ""
    new: str = ""

    @property
    def __name__(self) -> str:
        return self.name

    def __call__(self, folder: Path) -> dict[str, Any]:
        from golden.runner import run_command, states

        path = folder / self.file
        original = path.read_text(encoding="utf-8") if self.file else ""
        if self.file:
            spoilt = original.replace(self.old, self.new, 1) if self.old else self.new
            assert spoilt != original, f"{self.name}: {self.file} has no {self.old!r}"
            path.write_text(spoilt, encoding="utf-8")
        before = states(folder)
        found = run_command(self.command)
        assert states(folder) == before, f"{self.name}: something written"
        if self.file:
            path.write_text(original, encoding="utf-8")
        assert found["exit"] in (1, 2), f"{self.name}: exit code {found['exit']}"
        assert "Traceback" not in "".join(found["text stderr"]), self.name
        return found


TABLE = (
    Mistake("no such table", "identify placed.toml nowhere.csv -q"),
    Mistake("an empty table", FIT, "placed.csv", "", ""),
    Mistake("a header alone", FIT, "placed.csv", "", "configuration,q1_rad,x_m\n"),
    Mistake("a column without a unit", FIT, "placed.csv", "x_m,", "x,"),
    Mistake("mixed units", FIT, "placed.csv", "y_m,", "y_mm,"),
    Mistake("a joint column that is missing", FIT, "placed.csv", "q6_rad", "note_6"),
    Mistake("an unknown column", FIT, "placed.csv", "force_x_N", "forse_x_N"),
    Mistake("no number", FIT, "placed.csv", "-2.78122528", "abc"),
    Mistake("NaN", FIT, "placed.csv", "-2.78122528", "nan"),
    Mistake("an empty field", FIT, "placed.csv", "-2.78122528", ""),
    Mistake("an unknown marker", FIT, "placed.csv", "1,M2,", "1,M7,"),
    Mistake("a decimal comma too many", FIT, "placed.csv", "-2.78122528", "-2,78122528"),
    Mistake("thousands separated", FIT, "placed.csv", "",
            "q1_deg;q2_deg;q3_deg;q4_deg;q5_deg;q6_deg;x_mm;y_mm;z_mm\n1;2;3;4;5;6;7,5;8;1.234,5\n"),
    Mistake("one row", FIT, "placed.csv", "",
            "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,marker\n"
            "0,-90,90,0,30,0,900,0,900,M1\n"),
    Mistake("one pose", FIT, "placed.csv", "",
            "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,marker,repeat\n"
            + "".join(f"0,-90,90,0,30,0,90{i},0,900,M1,{i}\n" for i in range(9))),
    Mistake("an output that is a folder", "identify placed.toml placed.csv -q -o study"),
    Mistake("a reading twice", FIT, "placed.csv", "1,M2,0", "1,M1,0"),
    Mistake("joints beyond limits", FIT, "placed.csv", "2.78380016", "12.78380016"),
    Mistake("a force beyond all measure", FIT, "placed.csv", "-1000.0", "-1e300"),
    Mistake("radians named degrees", FIT, "placed.csv", "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad",
            "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"),
    Mistake("metres named millimetres", FIT, "placed.csv", "x_m,y_m,z_m", "x_mm,y_mm,z_mm"),
    Mistake("columns swapped", FIT, "placed.csv", "x_m,y_m,z_m", "z_m,y_m,x_m"),
    Mistake("no unloaded reading", DEFLECT, "data.csv", "",
            "configuration,marker,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,"
            "force_x_N,force_y_N,force_z_N,x_m,y_m,z_m\n"
            + "".join(f"{k},M1,{9 * k},10,-20,-80,{k},0,0,0,{force},0.1,-1,1.2\n"
                      for k in range(9) for force in (0, -98) if force or k != 7)),
    Mistake("deflections without a load", DEFLECT, "data.csv", "force_z_N", "note_z"),
)  # fmt: skip
CELL = (
    Mistake("no such cell", "identify nowhere.toml placed.csv -q"),
    Mistake("TOML that does not parse", FIT, "placed.toml", "[model]", "[model"),
    Mistake("an unknown key", FIT, "placed.toml", "effects =", "efects ="),
    Mistake("an unknown table", FIT, "placed.toml", "[tracker]", "[traker]"),
    Mistake("an unknown effect", FIT, "placed.toml", "joint_offset", "joint_ofset"),
    Mistake("an effect at no joint", FIT, "placed.toml", "compliance:joint2", "compliance:joint9"),
    Mistake("a wrong type", FIT, "placed.toml", "range_um = 10", 'range_um = "ten"'),
    Mistake("a wrong length", FIT, "placed.toml", "[0.2, 0.05, 0.1]", "[0.2, 0.05]"),
    Mistake("an unknown way to observe", FIT, "placed.toml", '"position"', '"postion"'),
    Mistake("no robot's file", FIT, "placed.toml", '"arm.urdf"', '"leg.urdf"'),
    Mistake("distances from nowhere", DEFLECT, "deflecting.toml", '"deflection"', '"distance"'),
    Mistake("a flange is no link", FIT, "placed.toml", 'base = "base_link"', 'flange = "flnge"'),
    Mistake("a URDF that does not parse", FIT, "arm.urdf", "</robot>", ""),
    Mistake("a URDF with a loop", FIT, "arm.urdf", "</robot>",
            '<joint name="again" type="fixed"><parent link="link_5"/><child link="link_2"/></joint>'
            "</robot>"),
    Mistake("no flange among several", FIT, "arm.urdf", "</robot>",
            '<link name="camera"/><joint name="c" type="fixed"><parent link="link_6"/>'
            '<child link="camera"/></joint></robot>'),
    Mistake("a link beyond all measure", FIT, "arm.urdf", "0.000 0.750", "0.000 750"),
    Mistake("a mass beyond all measure", FIT, "arm.urdf", 'mass value="330"', 'mass value="1e19"'),
    Mistake("a centre of mass beyond all measure", FIT, "arm.urdf", '<origin xyz="0.1 0 -0.1"',
            '<origin xyz="0 0 1e19"'),
    Mistake("a marker beyond all measure", FIT, "placed.toml", "[0.2, 0.05", "[1e19, 0.05"),
    Mistake("a DH table without a column", DEFLECT, "arm.csv", "alpha_deg", "alpha"),
    Mistake("a negative mass", DEFLECT, "links.csv", "1,11,", "1,-11,"),
    Mistake("a knowledge of nobody", f"{DEFLECT} --knowledge knowledge.toml", "knowledge.toml",
            'parameter = "joint3.compliance"', 'parameter = "joint3.complaince"'),
    Mistake("knowledge with a negative deviation", f"{DEFLECT} --knowledge knowledge.toml",
            "knowledge.toml", "std = 3e-8", "std = -3e-8"),
    Mistake("an unknown key of knowledge", f"{DEFLECT} --knowledge knowledge.toml",
            "knowledge.toml", "", "bound = 1\n"),
    Mistake("knowledge that contradicts itself", f"{DEFLECT} --knowledge knowledge.toml",
            "knowledge.toml", "",
            '[[bounds]]\nparameter = "joint2.compliance"\nlower = 1e-6\n[[equality]]\n'
            'terms = { "joint2.compliance" = 1.0 }\nvalue = 1e-7\nlabel = "data sheet"\n'),
    Mistake("knowledge of what no reading shows", f"{FIT} --knowledge knowledge.toml",
            "knowledge.toml", "", '[[equality]]\nterms = { "joint1.offset" = 1.0, '
            '"joint6.offset" = -1.0 }\n'),
    Mistake("a limit of the cell", f"{FIT}", "placed.toml", "[limits]",
            "[require]\nheldout_um = -1\n[limits]"),
    Mistake("an obstacle without a size", "design planned.toml -o plan.csv -q", "planned.toml",
            "size_m = [1.2, 0.8, 0.2]", ""),
    Mistake("levels of two joints", "design planned.toml -o plan.csv -q", "planned.toml",
            "joint2_deg = [-30, 20, 60]", "joint2_deg = [-30]\njoint3_deg = [10]"),
)  # fmt: skip
OPTIONS = (
    Mistake("no such verb", "identfy placed.toml placed.csv"),
    Mistake("no such option", f"{FIT} --methd ols"),
    Mistake("a missing argument", "identify placed.toml"),
    Mistake("an option without effect is taken", "identify no.toml placed.csv --jobs 2"),
    Mistake("a cell as a table", "identify placed.toml placed.toml"),
    Mistake("a cell as a result", "compensate placed.toml placed.toml targets.csv -o out.csv"),
    Mistake("an unknown method", f"{FIT} --method sideways"),
    Mistake("an unknown noise", f"{FIT} --noise loud"),
    Mistake("unknown weights", f"{FIT} --weights heavy"),
    Mistake("unknown intervals", f"{FIT} --intervals wide"),
    Mistake("weights that nothing states", f"{FIT} --weights axis"),
    Mistake("a parameter that is not there", f"{FIT} --fix joint2.ofset"),
    Mistake("everything held", f"{FIT} --fix base_frame --fix joint_offset --fix marker_position "
            "--fix joint2.compliance"),
    Mistake("a limit of nothing", f"{FIT} --require held=1"),
    Mistake("a negative limit", f"{FIT} --require heldout=-1"),
    Mistake("a negative seed", f"{FIT} --seed -1"),
    Mistake("no folder to write to", f"{FIT} --report no/page.html"),
    Mistake("an output over an input", "identify placed.toml placed.csv -q -o placed.csv"),
    Mistake("an empty argument", f"{FIT} --report ''"),
    Mistake("no file of knowledge", f"{DEFLECT} --knowledge none.toml"),
    Mistake("a method without constraints", f"{DEFLECT} --physical --method huber"),
    Mistake("a draw for smaller loads", "simulate placed.toml placed.csv -o o.csv --draw 1e6"),
    Mistake("no file of a covariance", f"{DEFLECT} --covariance noise.csv"),
    Mistake("a folder as a covariance", f"{DEFLECT} --covariance study"),
    Mistake("a covariance of two rows", f"{DEFLECT} --weights covariance --covariance links.csv",
            "links.csv", "", "1,0\n0,1\n"),
    Mistake("no covariance", f"{DEFLECT} --weights covariance"),
    Mistake("a covariance of another size", f"{DEFLECT} --weights covariance --covariance "
            "links.csv"),
    Mistake("an unknown effect left out", "diagnose placed.toml placed.csv -q --without baklash"),
    Mistake("poses without a plan", "diagnose placed.toml placed.csv -q --poses 4"),
    *(Mistake(f"no folder for diagnose {option}", f"diagnose placed.toml placed.csv -q {option} "
              "no/file.csv") for option in ("-o", "--report", "--plan", "--cell-out")),
    *(Mistake(f"diagnose {option} over an input", f"diagnose placed.toml placed.csv -q {option} "
              f"{name}") for option, name in
      (("-o", "placed.toml"), ("--report", "placed.csv"), ("--cell-out", "arm.urdf"))),
    Mistake("two outputs in one file", "diagnose placed.toml placed.csv -q -o out --report out"),
    Mistake("no table to diagnose", "diagnose placed.toml none.csv -q"),
    Mistake("no cell to diagnose", "diagnose none.toml placed.csv -q"),
    Mistake("poses beyond all measure", f"diagnose placed.toml placed.csv -q --plan p.csv --poses "
            f"{'9' * 30}"),
    Mistake("a plan of no poses", f"{DESIGN} --poses 0"),
    Mistake("a target and a number", f"{DESIGN} --poses 4 --target 10"),
    Mistake("an unknown criterion", f"{DESIGN} --criterion Z"),
    Mistake("an unknown effort", "design wished.toml -o plan.csv --effort little -q"),
    Mistake("a kept pose that is not there", f"{DESIGN} --poses 9 --keep poses.csv:1,99"),
    Mistake("pairs that show no noise", NEXT, "wished.toml", "sigma_um = 10\n", ""),
    *(Mistake(f"a batch with {options}", f"{NEXT} {options}") for options in (
        "--least-gain 100", "--require heldout=50", "--require new_poses=0", "--require 50")),
    Mistake("a target of two numbers", "compensate placed.toml placed.json --target 1,2 -q"),
    Mistake("an unknown frame", "compensate placed.toml placed.json --target 1500,200,1200 "
            "--frame tool -q"),
    Mistake("a target out of reach", "compensate placed.toml placed.json --target 9000,0,0 "
            "--point M1 -q -o out.csv"),
    Mistake("a box without extent", "compensate placed.toml placed.json --table t.csv --box "
            "500,0,500,500,100,600 -q"),
    Mistake("nothing to compensate", COMPENSATE),
    *(Mistake(f"targets with {options}", f"{COMPENSATE} targets.csv {options}")
      for options in ("--frame world", "--target 1,2,3", "--point M3", "--point 1,2", "--near 0,0",
                      "--near 190,0,0,0,0,0", "--load 0 0 -5", "--grid 3", "-o targets.csv",
                      "-o nowhere/c.csv", "--load 0 0 nan", "-o result.json")),
    *(Mistake(f"a correction table with {options}", f"{COMPENSATE} --table t.csv {options}")
      for options in ("--grid a", "--grid 1000,1000,1000,1000,1000,1", "--rotation 0,0,0",
                      "--box 1,2,3")),
    Mistake("a target of words", f"{COMPENSATE} --target 1,2,x"),
    Mistake("no table of targets", f"{COMPENSATE} missing.csv"),
    Mistake("a result without columns", f"{COMPENSATE} targets.csv", "result.json",
            '"covariance": [[', '"covariance": [[1], ['),
    Mistake("a result of brackets", f"{COMPENSATE} targets.csv", "result.json", "", "[" * 99_999),
    Mistake("another robot", "compensate placed.toml placed.json --target 1500,200,1200 -q",
            "arm.urdf", "0.000 0.750", "0.000 0.760"),
    Mistake("a result of another robot", "compensate placed.toml result.json --target 1,2,3 -q"),
    Mistake("no result at all", "export placed.toml placed.csv -o out.urdf -q"),
    *(Mistake(f"an export with {options}", f"{EXPORT} {options}")
      for options in ("-o a", "-o a.urdf --format urd", "-o no/folder/a.urdf", "-o arm.urdf",
                      "-o placed.toml --format dh", "-o placed.json", "-o a.urdf --load nan 0 0",
                      "-o a.urdf --temperature-c inf", "-o a.urdf --load 0 0 -1e7 --poses 5")),
    Mistake("a result of another cell", f"{EXPORT} -o a.urdf", "placed.toml", '"joint_offset", ',
            ""),
    Mistake("an unknown format", "export placed.toml placed.json -o out.step -q"),
    *(Mistake(f"an import of {words}", f"import {words}")
      for words in (f"points.txt {POINTS}", "points.txt -o d.csv",
                    f"points.txt -o points.txt {POINTS}",
                    f"none.txt -o d.csv {POINTS}", "points.txt -o d.csv --preset kukka",
                    f"points.txt -o d.csv {POINTS} --preset kuka",
                    f"points.txt points.txt -o d.csv {POINTS} --preset kuka",
                    f"points.txt poses.dat -o no/d.csv {POINTS} --preset kuka",
                    "poses.dat -o d.csv --preset kuka", f"points.txt -o d.csv {POINTS}",
                    f"placed.toml -o d.csv {POINTS}", "points.txt poses.dat -o d.csv", "")),
    Mistake("an unknown preset", "import points.txt poses.dat --preset spatialanlyzer -o out.csv"),
    Mistake("an unknown unit", "import points.txt poses.dat --preset spatialanalyzer --preset kuka "
            "--length-unit yards -o out.csv"),
    Mistake("an effect without a true value", "simulate placed.toml plan270.csv -o out.csv --set "
            "joint2.complaince=1e-6"),
    Mistake("a cell that is there", "init arm.urdf -o placed.toml"),
    *(Mistake(f"a first cell of {words}", f"init {words}")
      for words in ("fixture.stl", "none.urdf", "arm.csv --flange a -o o.toml",
                    "arm.urdf --flange flunge -o o.toml",
                    "arm.urdf --convention modified -o o.toml")),
    *(Mistake(f"a draw of {draw}", f"simulate placed.toml plan270.csv -o o.csv --draw {draw}")
      for draw in ("-1", "nan", "inf")),
    *(Mistake(f"simulate with {words}", f"simulate placed.toml plan270.csv {words}")
      for words in ("-o plan270.csv", "-o placed.toml", "-o arm.urdf", "-o o.csv --truth o.csv",
                    "-o o.csv --load 0 0 nan", "-o o.csv --seed -1")),
    Mistake("an unknown convention", "init arm.csv -o out.toml --convention other"),
    Mistake("a study without its file", "study nowhere -q"),
    Mistake("a study's option of another type", "study study --set scale=big -q"),
    Mistake("results over a study", "study study -o study -q"),
    Mistake("a folder without a study", "study . -q"),
    Mistake("a study's unknown option", "study study --set replcates=2 -q"),
    Mistake("results to compare that are none", "compare placed.csv june.json --cell placed.toml "
            "-q"),
)  # fmt: skip
# What went, with its successor.
GONE = (
    Mistake("the compiled backend", "--backend compiled effects placed.toml"),
    Mistake("an estimator that goes by another name", "identify placed.toml placed.csv "
            "-q -o out.json --method mm"),
    Mistake("wild intervals", "identify placed.toml placed.csv -q -o out.json --intervals wild"),
    Mistake("hc4 intervals", "identify placed.toml placed.csv -q -o out.json --intervals hc4"),
    Mistake("bootstrap intervals", "identify placed.toml placed.csv -q -o out.json "
            "--intervals bootstrap"),
)  # fmt: skip
