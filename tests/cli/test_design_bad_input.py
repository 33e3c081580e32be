"""Every plan that cannot be has one message that says why and what to do, and leaves nothing."""

import re

import pytest
from support.design_commands import (
    BARE,
    POSITION,
    design,
    elastocal,
    everything_in,
    planned,
    write_cell,
)

from elastocal.planning.criteria import CRITERIA

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


# id: (cell, exit code, fragments of the message)
# id: (options, exit code, fragments of the message)
@pytest.mark.parametrize("options", [("--poses", "1"), ("--curve", "1,6")])
def test_fewer_equations_than_parameters(tmp_path, options):
    told = "1 poses of 18 readings give 18, for \\d+ parameters; plan at least 2"
    refused(write_cell(tmp_path, POSITION), 1, "fewer equations", told, extra=options)


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
