"""Bad inputs of `design`: cells, wishes and options that no plan can fit."""

from __future__ import annotations

from golden.mistakes import DESIGN, Mistake

QUICK = "design wished.toml -o plan.csv --candidates 60 --poses 4 --effort quick -q"
POINT = "[[design.test_pose]]\nq_deg = [0, 20, -20, 0, 40, 0]\n"
BLOCK = """[workspace]\nlink_radius_mm = 50\n[[workspace.obstacle]]\nname = "block"\nshape = "box"
position_m = [0.7, 0, 0]\nsize_m = """
JOINTS = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"


def added(name: str, text: str, command: str = QUICK) -> Mistake:
    """With `text` before the wishes for a plan."""
    return Mistake(name, command, "wished.toml", "[design]", f"{text}\n[design]")


def asked(name: str, wishes: str) -> Mistake:
    loads = "[design]\nloads_N = [[0, 0, 0], [0, 0, -98]]\n"
    wished = loads if "loads_N" not in wishes else "[design]\n"
    old = f'{loads}prior = "typical"'
    return Mistake(name, QUICK, "wished.toml", old, wished + wishes)


def optioned(name: str, options: str) -> Mistake:
    return Mistake(name, f"{QUICK} {options}")


TABLE = (
    added("limits the wrong way round", "[limits]\njoint2_deg = [10, -10]"),
    added("limits beyond the robot's", "[limits]\njoint2_deg = [200, 300]"),
    added("a test pose beyond the limits", f"[limits]\njoint2_deg = [-50, -40]\n{POINT}"),
    added("a test box out of reach", "[design.test_box]\nlower_m = [5, 5, 5]\nupper_m = [6, 6, 6]"),
    added("an obstacle that swallows the robot", f"{BLOCK}[9, 9, 9]"),
    added("a home in a wall",
          f"[design.motion]\nhome_deg = [0, 90, -90, 0, 0, 0]\n{BLOCK}[0.1, 3, 3]"),
    added("a tracker that sees no pose", "[workspace.visibility]\nrange_m = [0.1, 0.2]"),
    asked("a parameter that no pose shows", 'criterion = "D"\ninterest = ["joint1.compliance"]'),
    asked("a parameter of interest that is none",
           'criterion = "D"\ninterest = ["joint1.complaince"]'),
    asked("a criterion that is none", 'criterion = "test_poses"'),
    asked("c without a combination", 'criterion = "c"\n'),
    asked("a combination of nothing known",
           'criterion = "c"\ncombination = { "joint2.complance" = 1.0 }\n'),
    Mistake("no noise", QUICK, "wished.toml", "sigma_um = 10", ""),
    asked("a plan of deflections without a load", "loads_N = [[0, 0, 0]]"),
    asked("a choice of load per pose", "load_choice = true"),
    asked("a criterion that is gone", 'criterion = "O2"'),
    asked("plans for drawn arms", 'robust = "average"'),
    added("fewer poses than levels", "[design.levels]\njoint2_deg = [-40, -50, -60]",
          QUICK.replace("--poses 4", "--poses 2")),
    added("a level beyond the limits", "[design.levels]\njoint2_deg = [-40, 140]"),
    Mistake("nothing to fit", QUICK, "wished.toml", '["joint_compliance"]', "[]"),
    asked("a combination that no pose shows",
          'criterion = "c"\ncombination = { "joint1.compliance" = 1.0 }'),
    Mistake("fewer equations than parameters", "design placed.toml -o p.csv --poses 1 "
            "--candidates 60 --effort quick -q --criterion D"),
    optioned("a picture over a folder", "--picture study"),
    optioned("a seed below zero", "--seed -1"),
    optioned("a parameter to fix that is none", "--fix joint2.complance"),
    optioned("poses beyond all measure", f"--candidates {'9' * 30}"),
    optioned("fewer candidates than poses", "--poses 99"),
    optioned("a criterion in small letters", "--criterion d"),
    optioned("an effort misspelt", "--effort quik"),
    optioned("a curve of words", "--curve 10,many"),
    optioned("a curve of nothing", "--curve 0,3"),
    optioned("a curve beyond the candidates", "--curve 3,99"),
    optioned("a program of no controller", "--program moves.txt"),
    optioned("a picture of another kind", "--picture poses.jpg"),
    optioned("a picture in no folder", "--picture none/poses.png"),
    optioned("two outputs of one name", "--program a.src --program a.src"),
    optioned("no knowledge", "--knowledge none.toml"),
    optioned("nothing to augment", "--augment none.csv"),
    optioned("no jobs", "--jobs 0"),
    optioned("no candidates", "--candidates 0"),
    Mistake("a target in µm for D", DESIGN + " --criterion D --target 9"),
    Mistake("a target that cannot be met", DESIGN + " --criterion test_pose --target 0.01"),
    Mistake("a negative target", DESIGN + " --target -1"),
    Mistake("a target that is no number", DESIGN + " --target nan"),
    Mistake("a plan over the cell", "design wished.toml -o wished.toml -q"),
    Mistake("a plan beside itself", "design wished.toml -o plan.json -q"),
    Mistake("a path out of reach", "design planned.toml -o plan.csv -q", "path.csv", "",
            "x_mm,y_mm,z_mm\n900,0,900\n9000,0,0\n"),
    Mistake("a path beyond the limits", "design planned.toml -o plan.csv -q", "path.csv",
            "30,40,-30", "30,140,-30"),
    Mistake("measurements of another robot", QUICK + " --augment data.csv", "data.csv", "",
            f"{JOINTS},q7_deg,x_mm,y_mm,z_mm\n1,2,3,4,5,6,7,1,1,1\n"),
    Mistake("measurements without a position", QUICK + " --augment data.csv", "data.csv", "",
            f"{JOINTS}\n1,2,3,4,5,6\n"),
    Mistake("measurements without a load", QUICK + " --augment data.csv", "data.csv", "",
            f"marker,{JOINTS},x_mm,y_mm,z_mm\nM1,0,-9,9,0,9,0,1,1,1\n"),
    Mistake("knowledge without a prior", QUICK + " --knowledge knowledge.toml", "knowledge.toml",
            "", "physical = true\n"),
    Mistake("measurements of another marker", QUICK + " --augment data.csv", "data.csv", "",
            f"marker,{JOINTS},x_mm,y_mm,z_mm\nM7,0,-9,9,0,9,0,1,1,1\n"),
    Mistake("measurements of two joints", QUICK + " --augment data.csv", "data.csv", "",
            "q1_deg,q2_deg\n1,2\n"),
    Mistake("knowledge of no parameter", QUICK + " --knowledge knowledge.toml", "knowledge.toml",
            "", '[prior."joint2.complance"]\nmean = 0\nstd = 1\n'),
    Mistake("knowledge without a spread", QUICK + " --knowledge knowledge.toml", "knowledge.toml",
            "", '[prior."joint2.compliance"]\nmean = 0\nstd = 0\n'),
)  # fmt: skip
