"""Results in a notebook: HTML without anybody's markup, figures, data frames."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from support.diagnoses import VERDICTS
from support.pages import Page

import elastocal as ec
from elastocal.above import Result
from elastocal.messages import InputError


def test_names_of_the_user_are_no_markup(hostile):
    page = Page(hostile.result._repr_html_())
    told = "table thead tbody tr th td p h4 h5 section span svg line circle dl dt dd ul li div"
    assert set(page.tags) <= {*told.split(), "details", "summary"}
    assert "alert(1)" in page.text
    assert "\x1b" not in hostile.result._repr_html_()
    hostile.result.plot()
    figure = hostile.result.plot(interactive=True).to_json()
    assert "<script" not in figure.lower()


def test_only_the_arm_is_turned_and_other_figures_are_named(case):
    with pytest.raises(InputError, match="stands still; interactive=True turns the arm: space"):
        case.result.plot("waterfall", interactive=True)
    with pytest.raises(InputError, match=r"'waterfal'.*did you mean 'waterfall'.*sureness"):
        case.result.plot("waterfal")


def test_identification_as_a_frame(case):
    frame = case.result.to_dataframe()
    assert list(frame.parameter) == [e.name for e in case.result.estimates]
    for row, e in zip(frame.itertuples(), case.result.estimates, strict=True):
        assert row.held == e.held
        assert row.value == e.value if e.identifiable else np.isnan(row.value)
    kept = frame[frame.identifiable]
    assert (kept.ci95_low < kept.value).all() and (kept.value < kept.ci95_high).all()


@pytest.mark.parametrize("name", ["two", "many"])
def test_diagnosis_as_html_and_frame(name):
    d = VERDICTS[name]
    text = Page(d._repr_html_()).text
    assert "noise alone" in text
    frame = d.to_dataframe()
    tried = {(c.effect, c.where) for c in d.candidates}
    found = {(f.effect, f.where) for f in d.effects}
    only = [f.effect for f in d.effects if (f.effect, f.where) not in tried]
    assert list(frame.effect) == [*only, *(c.effect for c in d.candidates)]
    assert set(zip(frame.effect[frame.found], frame["where"][frame.found], strict=True)) == found
    assert ("Causes of the remaining error" in text) == bool(d.groups)


def test_figures_are_matplotlibs_and_hold_every_reading(case):
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    figure = case.result.plot()
    assert isinstance(figure, Figure)
    of_dots = (line for line in figure.axes[0].lines if line.get_solid_capstyle() == "round")
    points = sum(len(line.get_xdata()) // 3 for line in of_dots)
    assert points == len(case.result.observations.lead)
    # In pixels too: a line of no length has no caps in a PNG.
    image = imread(io.BytesIO(figure._repr_png_()), format="png")[::-1]
    left, low, right, high = figure.axes[0].bbox.extents.astype(int)
    assert (np.ptp(image[low:high, left:right, :3], axis=2) > 0.15).sum() > points


def test_interactive_plan_shows_every_pose(plan):
    names = [trace.name for trace in plan.plot(interactive=True).data]
    told = [n for n in names if n and n.startswith("pose")]
    assert told == ["pose 1", "pose 2", "pose 3", "pose 4"]


def test_the_figures_that_are_documented_are_those_there_are():
    """Docstring and page name every figure that a result may have, and no other."""
    sources = (Path(ec.__file__).parent / "report").glob("*.py")
    made = " ".join(path.read_text(encoding="utf-8") for path in sources)
    there = set(re.findall(r'"(\w+)"', " ".join(re.findall(r"figures=\(([^)]*)\)", made))))
    told = Result.plot.__doc__.split("kind:")[1].split("interactive:")[0]
    assert set(re.findall(r'"(\w+)"', told)) == there
    page = (Path(__file__).parents[2] / "docs" / "notebooks.md").read_text(encoding="utf-8")
    rows = [row.split("|")[2] for row in page.splitlines() if row.startswith("| `")]
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == there
