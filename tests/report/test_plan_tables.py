"""A plan on the terminal: every key figure, at any width."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console
from support.cells import kr270_cell

from elastocal.cell.arm_description import CartesianNoise, Tracker
from elastocal.cell.plan_wishes import DesignSpec
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.plan import Certificate, PlanSize
from elastocal.report.plan_terminal import print_plan
from elastocal.report.plan_view import plan_lines, served
from elastocal.report.terminal import PRINTED_WIDTH, printed_text

LOADS = np.array([[0, 0, 0], [0, 0, -2600.0]])


@pytest.fixture(scope="module")
def plan():
    spec = DesignSpec(poses=4, loads=LOADS, candidates=30, levels={"joint2": (-0.5, -1.0)})
    cell = kr270_cell(["joint_compliance"], observe="deflection")
    cell = replace(cell, tracker=Tracker(noise=CartesianNoise(np.full(3, 1e-5))), design=spec)
    return design(cell, DesignOptions(effort="quick"))


def printed(plan, width):
    stream = io.StringIO()
    print_plan(Console(file=stream, width=width, highlight=False), plan)
    return stream.getvalue()


def words(text):
    """The text without line breaks, so that a sentence is found wherever it was folded."""
    return " ".join(text.split())


@pytest.mark.parametrize("width", [60, 80, 140])
def test_every_key_figure_is_told_within_the_width(plan, width):
    text = printed(plan, width)
    assert max(cell_len(line) for line in text.splitlines()) <= width
    told = words(text)
    assert f"ρ₀ = {1e6 * plan.everywhere.test_poses:.4g} µm" in told
    assert f"{1e6 * plan.everywhere.elsewhere:.4g} µm rms all over the joint ranges" in told
    assert f"certified on the pool: efficiency {plan.certificate.efficiency_pool:.4f}" in told
    assert (
        f"estimated on the continuum: efficiency {plan.certificate.efficiency_continuum:.4f}"
        in told
    )
    assert f"{plan.candidates.feasible} feasible of {plan.candidates.tried} tried" in told
    for p in plan.predicted:
        assert p.name in told
    decimals = 2 if width > 60 else 1
    for q in np.degrees(plan.q).ravel():
        assert f"{q:.{decimals}f}" in told
    assert "no feasible pose shows joint1.compliance" in told
    assert f"{len(plan.execution.stops)} stops" in told


def test_without_a_bound_it_says_why(plan):
    other = replace(
        plan,
        criterion="O2",
        unit="",
        certificate=Certificate(30, None, None),
        chance=replace(plan.chance, efficiency=None),
    )
    lines = [text for label, text in plan_lines(other) if label == "Certificate"]
    assert lines == ["none: O2 is not convex, so no bound is known."]
    assert "efficiency" not in words(printed(other, 80))


def test_what_chance_would_have_given(plan):
    def told(**changes) -> str:
        other = replace(plan, chance=replace(plan.chance, **changes))
        return dict(plan_lines(other))["Chance"]

    text = told(median=9.876, best=8.0, worst=None, efficiency=0.254, determined=18, n=20)
    name = "the weighted error" if plan.everywhere.share else "ρ₀"
    assert "median of 20 random plans" in text
    assert f"{name} = 9.876 µm (best 8, worst no value)" in text
    assert "efficiency of 0.25 against this plan" in text
    assert "2 of 20 random plans of as many feasible poses leave parameters open" in text
    text = told(median=None, best=8.0, worst=None, efficiency=None, determined=3, n=20)
    assert text.startswith("17 of 20 random plans") and "median" not in text


def test_a_pose_that_carries_a_parameter_alone_says_so(plan):
    reason = replace(
        plan.reasons[0], serves=(("joint3.compliance", np.inf), ("joint2.offset", 1.5))
    )
    assert served(reason) == "joint3.compliance lost, joint2.offset +50 %"
    assert served(replace(reason, serves=())) == "all a little"


@pytest.mark.parametrize("width", [60, 80, 140])
def test_loads_curve_sums_and_warnings_fit_too(plan, width):
    sums = tuple(
        replace(p, combined_with=tuple(f"link{i}.rz" for i in range(9))) for p in plan.predicted
    )
    other = replace(
        plan,
        load=np.array([0, 1, 0, 1]),
        curve=(PlanSize(4, 3.25, 3.0), PlanSize(8, 2.125, None)),
        predicted=sums,
        warnings=("a warning with [brackets] and a very long word " + 90 * "x",),
    )
    text = printed(other, width)
    assert max(cell_len(line) for line in text.splitlines()) <= width
    told = words(text)
    assert "3.25" in told and "2.125" in told and "and 6 more" in told
    assert "-2600" in told
    assert "[brackets]" in told


def test_print_of_a_plan_is_what_the_terminal_shows(plan):
    text = str(plan)
    assert text == printed_text(print_plan, plan)
    joined = " ".join(text.split())
    for label, sentence in plan_lines(plan):
        assert f"{label}: {sentence}" in joined
    assert max(map(len, text.splitlines())) <= PRINTED_WIDTH and "\x1b" not in text
