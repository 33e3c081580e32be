"""Results in a notebook: HTML without anybody's markup, figures, data frames."""

import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from support.cells import MARKERS, kr270_chain, random_table
from support.diagnoses import VERDICTS

from elastocal.errors import InputError
from elastocal.measurements import read_measurements
from elastocal.report.figures import INK
from elastocal.report.notebook import view_of
from elastocal.report.page import figures_of, page_of
from elastocal.report.residual_view import residuals_of

VOID = {"br", "hr", "img"}


class Balanced(HTMLParser):
    """Tags that open and close in order, and the words between them."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.words = [], set(), []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        assert not [name for name, _ in attrs if name.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def parsed(result):
    page = Balanced()
    page.feed(result._repr_html_())
    assert page.open == []
    return page


@pytest.fixture(scope="module")
def plan():
    from dataclasses import replace

    from support.cells import kr270_cell

    from elastocal.cell.arm_description import CartesianNoise, Tracker
    from elastocal.cell.plan_wishes import DesignSpec
    from elastocal.planning.design import DesignOptions, design

    loads = np.array([[0, 0, 0], [0, 0, -2600.0]])
    spec = DesignSpec(poses=4, loads=loads, candidates=30, levels={"joint2": (-0.5, -1.0)})
    cell = kr270_cell(["joint_compliance"], observe="deflection")
    cell = replace(cell, tracker=Tracker(noise=CartesianNoise(np.full(3, 1e-5))), design=spec)
    return design(cell, DesignOptions(effort="quick"))


def test_identification_shows_what_it_determined(case):
    page = parsed(case.result)
    text = " ".join(page.words)
    known = [e.name for e in case.result.estimates if e.identifiable]
    assert known and all(name in text for name in known)
    assert "Readings:" in text


def test_names_of_the_user_are_no_markup(hostile):
    page = parsed(hostile.result)
    assert page.tags <= {"table", "caption", "thead", "tbody", "tr", "th", "td", "p", "b"}
    assert "alert(1)" in " ".join(page.words)
    assert "\x1b" not in hostile.result._repr_html_()
    for interactive in (False, True):
        hostile.result.plot(interactive=interactive)
    figure = hostile.result.plot(interactive=True).to_json()
    assert "<script" not in figure.lower()


def test_identification_as_a_frame(case):
    frame = case.result.to_dataframe()
    assert list(frame.parameter) == [e.name for e in case.result.estimates]
    for row, e in zip(frame.itertuples(), case.result.estimates, strict=True):
        assert row.held == e.held
        assert row.value == e.value if e.identifiable else np.isnan(row.value)
    kept = frame[frame.identifiable]
    assert (kept.ci95_low < kept.value).all() and (kept.value < kept.ci95_high).all()


def test_plan_as_html_and_frame(plan):
    frame = plan.to_dataframe()
    np.testing.assert_allclose(np.radians(frame.filter(regex="^q").to_numpy()), plan.q)
    assert sorted(frame.order) != [] and set(frame.level) <= {1, 2}
    text = " ".join(parsed(plan).words)
    assert "q1 °" in text and "Certificate:" in text


@pytest.mark.parametrize("name", VERDICTS)
def test_diagnosis_as_html_and_frame(name):
    d = VERDICTS[name]
    text = " ".join(parsed(d).words)
    assert "Verdict:" in text and "noise alone" in text
    frame = d.to_dataframe()
    tried = {(c.effect, c.where) for c in d.candidates}
    found = {(f.effect, f.where) for f in d.effects}
    only = [f.effect for f in d.effects if (f.effect, f.where) not in tried]
    assert list(frame.effect) == [*only, *(c.effect for c in d.candidates)]
    assert set(zip(frame.effect[frame.found], frame["where"][frame.found], strict=True)) == found
    assert ("What the gap is made of" in text) == bool(d.groups)


def drawn_points(figure):
    """Every x value of the plotted lines of a matplotlib figure."""
    return np.concatenate(
        [np.asarray(line.get_xdata(), float) for axes in figure.axes for line in axes.get_lines()]
    )


def test_figures_are_matplotlibs_and_hold_every_reading(case):
    from matplotlib.figure import Figure

    figure = case.result.plot()
    assert isinstance(figure, Figure)
    points = sum(len(patch.get_path().vertices) // 2 for patch in figure.axes[0].patches)
    assert points == len(case.result.observations.lead)
    assert figure._repr_png_().startswith(b"\x89PNG")
    figure.canvas.draw()


def test_kinds_of_figures(case, plan):
    for result in (case.result, plan, next(iter(VERDICTS.values()))):
        for kind in view_of(result).figures:
            result.plot(kind).canvas.draw()
            assert result.plot(kind, interactive=True).data
        with pytest.raises(InputError, match="there are "):
            result.plot("none of them")


def test_every_figure_of_the_page_is_there_in_its_own_colours(case):
    found = figures_of(case.result)
    assert {"waterfall", "spread", "sureness", "histogram"} <= set(found)
    figure = case.result.plot("spread")
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.axes[0].xaxis.label.get_color() == INK != "black"


def test_configurations_are_told_by_their_names_and_parameters_each_on_its_scale(case):
    ticks = case.result.plot().axes[-1].get_xticklabels()
    assert {tick.get_text() for tick in ticks} <= set(residuals_of(case.result).labels)
    figure = case.result.plot("parameters")
    assert np.abs(drawn_points(figure)).max() <= 1.0
    assert all("±" in tick.get_text() for tick in figure.axes[0].get_yticklabels())


def test_both_libraries_draw_the_same(case):
    still = drawn_points(case.result.plot("parameters"))
    moving = np.concatenate(
        [np.asarray(t.x, float) for t in case.result.plot("parameters", interactive=True).data]
    )
    assert set(np.round(moving, 9)) <= set(np.round(still, 9))


def test_interactive_plan_shows_every_pose(plan):
    names = [trace.name for trace in plan.plot(interactive=True).data]
    assert [n for n in names if n and n.startswith("pose")] == [
        "pose 1",
        "pose 2",
        "pose 3",
        "pose 4",
    ]


def test_measurements_as_a_frame_are_what_is_written(tmp_path):
    chain = kr270_chain()
    table = random_table(chain, 3, 1, markers=tuple(MARKERS))
    frame = table.to_dataframe()
    table.save(tmp_path / "t.csv")
    header = (tmp_path / "t.csv").read_text().split("\n")[0].split(",")
    assert list(frame.columns) == header
    back = read_measurements(tmp_path / "t.csv", joint_kinds=chain.kinds)
    np.testing.assert_array_equal(frame.filter(regex=r"^q\d").to_numpy(), back.q)
    assert re.search("<table", table._repr_html_())


def test_importing_a_result_does_not_import_its_views():
    code = (
        "import sys, elastocal.identification.result, elastocal.measurements\n"
        "print([m for m in sys.modules if m.startswith(('elastocal.report', 'matplotlib', "
        "'plotly', 'pandas'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- commands ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def commands():
    """Three targets, one of them out of reach, whose names are markup."""
    from support.cells import kr270_cell
    from support.commands import calibrated, erring

    from elastocal.compensation.compensate import compensate
    from elastocal.compensation.targets import targets_at
    from elastocal.model.calibrated_tool import tool_point
    from elastocal.model.manipulator import Model

    cell = kr270_cell(("joint_offset", "joint_compliance"))
    x = erring(Model.assembled(kr270_chain(), cell), np.random.default_rng(1), 0.5)
    arm = calibrated(kr270_chain(), cell, x, std=0.01)
    places = np.array([[1.8, 0.3, 1.5], [9.0, 0.0, 0.0], [1.8, -0.3, 1.5]])
    targets = targets_at("targets.csv", places, None, "base", np.array([0, 0, -2600.0]))
    named = replace(targets.table, configuration_labels=("<b>1", "NA", "3"))
    return compensate(arm, replace(targets, table=named), tool_point(cell, "M1"))


def test_commands_as_a_frame_are_those_of_the_file(commands):
    frame = commands.to_dataframe()
    assert list(frame["configuration"]) == ["<b>1", "NA", "3"]
    assert list(frame["status"]) == ["reached", "not reached", "reached"]
    q = frame[[f"q{k}_deg" for k in range(1, 7)]].to_numpy()
    np.testing.assert_allclose(q[[0, 2]], np.degrees(commands.q[[0, 2]]), rtol=0, atol=1e-9)
    assert np.isnan(q[1]).all()
    np.testing.assert_allclose(frame["std_um"][0], commands.uncertainty.std[0] * 1e6, rtol=1e-3)


def test_commands_as_html_say_what_is_reached_and_escape_names(commands):
    page = parsed(commands)
    words = " ".join(page.words)
    assert "2 of 3 targets reached by the marker M1" in words
    assert "<b>1" in words
    assert "not reached" in words and "nan" not in words


def test_the_page_of_commands_is_drawn_in_its_own_colours(commands):
    text = page_of(commands)
    assert text.count("<svg xmlns") == 2 and "data:image" not in text
    drawn = text[text.index("<svg xmlns") :]
    assert "var(--ink)" in drawn and INK not in drawn


def test_figures_of_commands_hold_every_target_reached(commands):
    reached = commands.before[commands.reached] * 1e6
    np.testing.assert_allclose(commands.plot(interactive=True).data[0].x, reached)
    std = commands.uncertainty.std[commands.reached] * 1e6
    np.testing.assert_allclose(commands.plot("uncertainty", interactive=True).data[0].x, std)
    commands.plot("errors").canvas.draw()
