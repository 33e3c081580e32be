"""Every plan that cannot be has one message that says why and what to do, and leaves nothing."""

import re

import pytest
from support.design_commands import (
    BARE,
    design,
    everything_in,
    planned,
    write_cell,
)

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


def test_a_refused_plan_leaves_the_one_of_before(tmp_path):
    cell = write_cell(tmp_path)
    planned(cell)
    refused(cell, 1, "target", extra=("--target", "0.01"))


def test_a_picture_that_cannot_be_written_leaves_no_half_file(tmp_path):
    cell = write_cell(tmp_path)
    (tmp_path / "poses.png").mkdir()
    refused(cell, 2, "poses.png is a directory", extra=("--picture", tmp_path / "poses.png"))
