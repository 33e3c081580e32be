"""Every plan that cannot be has one message that says why and what to do, and leaves nothing."""

import re

import pytest
from support.design_commands import (
    BARE,
    DEFLECTION,
    POSITION,
    TEST_POSES,
    altered,
    design,
    elastocal,
    everything_in,
    planned,
    write_cell,
)

from elastocal.planning.criteria import CRITERIA

CAPSULES = "\n[workspace]\nlink_radius_mm = [200, 200, 150, 150, 100, 100]\n"
BLOCK = """
[[workspace.obstacle]]
name = "block"
shape = "box"
size_m = [9, 9, 9]
position_m = [0, 0, 0]
"""
BOX = "\n[design.test_box]\nlower_m = [5, 5, 5]\nupper_m = [6, 6, 6]\n"
PATH = '\n[design.test_path]\nfile = "path.csv"\n'
JOINTS = ",".join(f"q{i}_deg" for i in range(1, 7))


def refused(cell, code, *fragments, extra=(), output="plan.csv"):
    """`design` must end with `code` and one message of the fragments, and write nothing."""
    before = {p: p.read_bytes() for p in cell.parent.iterdir() if p.is_file()}
    names = everything_in(cell.parent)
    result = design(cell, *extra, output=output)
    assert result.exit_code == code, result.stderr
    assert "Traceback" not in result.stderr
    for fragment in fragments:
        assert re.search(fragment, result.stderr), f"{fragment!r} not in {result.stderr!r}"
    assert everything_in(cell.parent) == names
    assert all(path.read_bytes() == content for path, content in before.items())


def limits(text):
    return DEFLECTION + f"\n[limits]\n{text}\n"


# id: (cell, exit code, fragments of the message)
CELLS = {
    "limits the wrong way round": (
        limits("joint2_deg = [10, -10]"), 2, ("cell.toml", "joint2", "lower < upper"),
    ),
    "limits beyond the robot's": (
        limits("joint2_deg = [200, 300]"), 2, (r"\[limits\] joint2", "no range"),
    ),
    "test pose beyond the limits": (
        limits("joint2_deg = [-50, -40]"), 2,
        (r"q_deg of \[\[design.test_pose\]\] no. 1", "joint2", "-90°", "-50° to -40°"),
    ),
    "test box out of reach": (
        BARE + BOX, 2, (r"\[design.test_box\]", "out of reach", "20 of 20", "make the box smaller"),
    ),
    "an obstacle that swallows the robot": (
        DEFLECTION + CAPSULES + BLOCK, 1,
        ("0 of 65536 candidates", "relax 'obstacle'", "block", "move or shrink", "ignored_pairs"),
    ),
    "a tracker that sees no pose": (
        DEFLECTION + "\n[workspace.visibility]\nrange_m = [0.1, 0.2]\n", 1,
        ("relax 'range'", r"range_m of \d\.\d+ m instead of 0.2 m", "half of those"),
    ),
    "a parameter that no pose shows": (
        altered(DEFLECTION, criterion='"D"', interest='["joint1.compliance"]'), 1,
        (r"\[design\] interest", "no feasible pose shows joint1.compliance", "load's direction"),
    ),
    "a parameter of interest that is none": (
        altered(DEFLECTION, criterion='"D"', interest='["joint1.complaince"]'), 2,
        ("'joint1.complaince'", "did you mean 'joint1.compliance'"),
    ),
    "a test pose whose position depends on it": (
        BARE + TEST_POSES.replace("q_deg", "load_N = [500, 500, 0]\nq_deg"), 1,
        ("position at test pose", "joint1.compliance", "no feasible pose shows"),
    ),
    "a criterion that is none": (
        altered(DEFLECTION, criterion='"test_poses"'), 2,
        ("cell.toml: key design.criterion takes", '"O4" or "O5"', "did you mean 'test_pose'"),
    ),
    "c without a combination": (
        altered(DEFLECTION, criterion='"c"'), 2, ("cell.toml", "design.combination", "missing"),
    ),
    "a combination of nothing known": (
        altered(DEFLECTION, criterion='"c"', combination='{ "joint2.complance" = 1.0 }'), 2,
        ("cell.toml", "'joint2.complance'", "did you mean 'joint2.compliance'"),
    ),
    "a combination that no pose shows": (
        altered(DEFLECTION, criterion='"c"', combination='{ "joint1.compliance" = 1.0 }'), 1,
        ("no feasible pose shows joint1.compliance",),
    ),
    "no noise": (
        DEFLECTION.replace("sigma_um = 10\n", ""), 2, ("noise of a reading", "sigma_um"),
    ),
    "deflections without a load": (
        altered(DEFLECTION, loads_N="[[0, 0, 0]]"), 2, ("needs a load", "loads_N"),
    ),
    "a choice of load for deflections": (
        altered(DEFLECTION, load_choice="true"), 2, ("load_choice has no meaning", "drop it"),
    ),
    "levels of two joints": (
        DEFLECTION + "\n[design.levels]\njoint2_deg = [-40]\njoint3_deg = [10]\n", 2,
        ("joint2 and joint3", "only one joint", r"\[limits\]"),
    ),
    "fewer poses than levels": (
        altered(DEFLECTION, poses="2") + "\n[design.levels]\njoint2_deg = [-40, -50, -60]\n", 2,
        ("design.poses is 2", "3 levels", "more poses or fewer levels"),
    ),
    "a level beyond the limits": (
        DEFLECTION + "\n[design.levels]\njoint2_deg = [-40, 40]\n", 2,
        ("joint2 at 40°", "beyond its limits"),
    ),
    "fewer candidates than poses": (
        altered(DEFLECTION, candidates="3"), 2, ("5 poses", "3 candidates", "--candidates"),
    ),
    "fewer feasible candidates than poses": (
        altered(DEFLECTION, poses="60")
        + CAPSULES
        + '\n[[workspace.keep_out]]\nname = "wall"\npoint_m = [2.15, 0, 0]\nnormal = [1, 0, 0]\n',
        1, ("no feasible pose found|feasible candidates were found", "relax"),
    ),
    "an effect that is none": (
        DEFLECTION.replace('["joint_compliance"]', "[]"), 2, ("nothing is left", "effects"),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("text", "code", "fragments"), CELLS.values(), ids=CELLS.keys())
def test_a_cell_that_no_plan_fits(tmp_path, text, code, fragments):
    refused(write_cell(tmp_path, text), code, *fragments)


# id: (options, exit code, fragments of the message)
OPTIONS = {
    "criterion": (("--criterion", "d"), 2, ("--criterion 'd'", "did you mean 'D'", "O5")),
    "criterion c": (
        ("--criterion", "c"), 2, ("cell.toml", "combination is missing", "combination = {"),
    ),
    "effort": (("--effort", "quik"), 2, ("'quik'", "did you mean 'quick'")),
    "curve of words": (("--curve", "10,many"), 2, ("--curve", "10,15,20", "many")),
    "curve of nothing": (("--curve", "0,3"), 2, ("curve", "0, 3")),
    "curve beyond the candidates": (("--curve", "3,99"), 2, ("99 poses", "60 candidates")),
    "target in µm for D": (
        ("--criterion", "D", "--target", "9"), 2, ("test_pose, robust, G and I", "not with D"),
    ),
    "target that cannot be met": (
        ("--target", "0.01"), 1,
        (r"target of 0.01 µm", r"up to 60 poses", r"reaches \d\.\d+ µm", "repeats"),
    ),
    "negative target": (("--target", "-1"), 2, ("--target", "positive", "-1")),
    "target that is no number": (("--target", "nan"), 2, ("--target", "positive", "nan")),
    "target and number of poses": (("--target", "9", "--poses", "4"), 2, ("--poses 4", "drop one")),
    "program": (("--program", "{}/moves.txt"), 2, ("moves.txt", ".src for KUKA KRL", ".script")),
    "picture": (("--picture", "{}/poses.jpg"), 2, ("poses.jpg", ".png or .svg")),
    "folder of the picture": (("--picture", "{}/none/poses.png"), 2, ("does not exist", "create")),
    "two outputs of one name": (
        ("--program", "{}/a.src", "--program", "{}/a.src"), 2, ("a.src", "two outputs"),
    ),
    "knowledge": (("--knowledge", "{}/none.toml"), 2, ("none.toml", "no such file")),
    "augment": (("--augment", "{}/none.csv"), 2, ("none.csv", "no such file")),
    "fix": (("--fix", "joint2.complance"), 2, ("joint2.complance", "did you mean")),
    "seed": (("--seed", "-1"), 2, ("--seed", "greater than or equal to 0")),
    "jobs": (("--jobs", "0"), 2, ("jobs", "found 0")),
    "poses": (("--poses", "0"), 2, ("--poses",)),
    "candidates": (("--candidates", "0"), 2, ("--candidates",)),
}  # fmt: skip


@pytest.mark.parametrize(("options", "code", "fragments"), OPTIONS.values(), ids=OPTIONS.keys())
def test_an_option_that_no_plan_fits(tmp_path, options, code, fragments):
    cell = write_cell(tmp_path, altered(DEFLECTION, poses="4"))
    refused(cell, code, *fragments, extra=[o.format(tmp_path) for o in options])


@pytest.mark.parametrize("options", [("--poses", "1"), ("--curve", "1,6")])
def test_fewer_equations_than_parameters(tmp_path, options):
    told = "1 poses of 18 readings give 18, for \\d+ parameters; plan at least 2"
    refused(write_cell(tmp_path, POSITION), 1, "fewer equations", told, extra=options)


PATHS = {
    "place out of reach": (
        "x_mm,y_mm,z_mm\n1500,0,1500\n9000,0,0\n", ("path.csv, line 3", "out of reach", "1 of 2"),
    ),
    "joints beyond the limits": (
        f"{JOINTS}\n0,-90,90,0,30,0\n0,90,90,0,30,0\n",
        ("path.csv, line 3, column q2_deg", "joint2", "90°", "beyond its limits"),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("path", "fragments"), PATHS.values(), ids=PATHS.keys())
def test_a_path_out_of_reach(tmp_path, path, fragments):
    (tmp_path / "path.csv").write_text(path)
    refused(write_cell(tmp_path, BARE + PATH), 2, *fragments)


KNOWLEDGE = {
    "unknown parameter": (
        '[prior."joint2.complance"]\nmean = 0\nstd = 1\n', ("joint2.complance", "did you mean"),
    ),
    "unknown parameter of a bound": (
        '[prior."joint2.compliance"]\nmean = 0\nstd = 1\n'
        '[[bounds]]\nparameter = "joint9.compliance"\nlower = 0\n', ("joint9.compliance",),
    ),
    "no prior": ("physical = true\n", ("states no prior", "leave --knowledge out")),
    "spread of zero": ('[prior."joint2.compliance"]\nmean = 0\nstd = 0\n', ("std", "positive")),
}  # fmt: skip


@pytest.mark.parametrize(("text", "fragments"), KNOWLEDGE.values(), ids=KNOWLEDGE.keys())
def test_knowledge_that_does_not_fit(tmp_path, text, fragments):
    (tmp_path / "known.toml").write_text(text)
    extra = ("--knowledge", tmp_path / "known.toml")
    refused(write_cell(tmp_path), 2, "known.toml", *fragments, extra=extra)


MEASURED = {
    "another robot": (f"{JOINTS},q7_deg,x_mm,y_mm,z_mm\n1,2,3,4,5,6,7,1,1,1\n", ("7 joint", "6")),
    "missing columns": ("q1_deg,q2_deg\n1,2\n", ("2 joint columns", "add q3_deg")),
    "no position": (f"{JOINTS}\n1,2,3,4,5,6\n", ("x_mm|position",)),
    "another marker": (
        f"marker,{JOINTS},x_mm,y_mm,z_mm\nM7,0,-9,9,0,9,0,1,1,1\n",
        ("line 2", "M7"),
    ),
    "no load": (f"marker,{JOINTS},x_mm,y_mm,z_mm\nM1,0,-9,9,0,9,0,1,1,1\n", ("loaded rows",)),
}


@pytest.mark.parametrize(("text", "fragments"), MEASURED.values(), ids=MEASURED.keys())
def test_measurements_that_do_not_fit(tmp_path, text, fragments):
    (tmp_path / "done.csv").write_text(text)
    extra = ("--augment", tmp_path / "done.csv")
    refused(write_cell(tmp_path), 2, "done.csv", *fragments, extra=extra)


@pytest.mark.parametrize(
    ("output", "fragment"),
    [
        ("none/plan.csv", "the folder .*none does not exist"),
        ("plan.json", r"name the plan \.csv"),
        ("cell.toml", "cell.toml is read and would"),
        ("arm.csv", "arm.json: goes beside"),
    ],
)
def test_an_output_that_cannot_be(tmp_path, output, fragment):
    # The table beside which arm.json, the report of arm.csv, would be written.
    (tmp_path / "arm.json").write_text(f"{JOINTS}\n0,-90,90,0,30,0\n")
    cell = write_cell(tmp_path, BARE + PATH.replace("path.csv", "arm.json"))
    refused(cell, 2, fragment, output=output)


def test_a_program_for_six_axes_is_refused_for_another_arm_before_the_work(tmp_path):
    rows = [f"{0.1 * i},{0.2 + 0.1 * i},0.3,{1.57 * (i % 2)}" for i in range(7)]
    (tmp_path / "arm.csv").write_text("\n".join(["theta0_rad,d_m,a_m,alpha_rad", *rows, ""]))
    text = re.sub(r"urdf = .*", 'dh = "arm.csv"\ndh_convention = "standard"', BARE)
    text = re.sub(r"joint_compliance = \[.*", "", text)
    cell = write_cell(tmp_path, text)
    refused(cell, 2, "--program .*moves.src", "six", extra=("--program", tmp_path / "moves.src"))


def test_the_message_stands_alone_on_stderr(tmp_path):
    cell = write_cell(tmp_path, altered(DEFLECTION, criterion='"c"'))
    result = design(cell)
    assert result.stdout == ""
    assert re.fullmatch(r"elastocal: [^\n]+\n", result.stderr)


def test_a_refused_plan_leaves_the_one_of_before(tmp_path):
    cell = write_cell(tmp_path)
    planned(cell)
    refused(cell, 1, "target", extra=("--target", "0.01"))


def test_a_picture_that_cannot_be_written_leaves_no_half_file(tmp_path):
    cell = write_cell(tmp_path)
    (tmp_path / "poses.png").mkdir()
    refused(cell, 2, "poses.png is a directory", extra=("--picture", tmp_path / "poses.png"))


def test_help_says_what_the_verb_is_for():
    result = elastocal("design", "--help")
    assert result.exit_code == 0
    assert "Which poses should I measure?" in result.stdout
    named = result.stdout.partition("--criterion <str>")[2].partition(";")[0]
    assert re.findall(r"\w+", named) == [*CRITERIA]
