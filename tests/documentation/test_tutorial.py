"""The tutorial's commands run, print what its page shows, and teach what it says they teach."""

import re
from pathlib import Path

import console_blocks
import numpy as np

import elastocal as ec

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial"

PAGE = (TUTORIAL / "index.md").read_text(encoding="utf-8")
PIECES = console_blocks.shown(PAGE)
TRUTH = {
    name: float(value)
    for name, value in re.findall(r"--set (\S+)=(\S+)", (TUTORIAL / "measure.sh").read_text())
}


def test_the_page_shows_what_the_commands_print(course):
    told = [
        f"$ {piece.command}\n{difference}"
        for piece, output in zip(PIECES, course.printed, strict=True)
        for difference in console_blocks.differences(piece, output)
    ]
    assert not told, "\n".join(told)


def parameters(result):
    return {p["name"]: p for p in result["parameters"]}


def test_with_a_stretched_wrist_only_the_sum_of_joints_4_and_6_is_known(course):
    first = course.results[0]
    found = parameters(first)
    assert found["joint4.compliance"]["value"] is None
    assert found["joint4.compliance"]["combined_with"] == ["joint6.compliance"]
    (known,) = first["combinations"]
    true = TRUTH["joint4.compliance"] + TRUTH["joint6.compliance"]
    assert abs(known["value"] - true) < 4 * known["std"] < 0.1 * true


def test_two_configurations_are_no_ground_for_trust(course, tmp_path):
    """`head -40 data.csv`: the residual agrees with the noise, and yet it says nothing."""
    lines = (course.folder / "data.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "head.csv").write_text("".join(lines[:40]), encoding="utf-8")
    fit = ec.identify(course.folder / "cell.toml", tmp_path / "head.csv")
    assert len(np.unique(fit.observations.configuration)) <= 3
    assert not fit.verdict.trusted
    assert "few_configurations" in fit.verdict.to_json()["missing"]


def test_a_sideways_pull_shows_what_no_pose_does(course):
    found = parameters(course.results[-1])
    assert {name for name, p in found.items() if p["identifiable"]} == set(TRUTH)
    for name, true in TRUTH.items():
        assert abs(found[name]["value"] - true) < 4 * found[name]["std"]
