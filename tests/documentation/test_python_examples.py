"""The Python that the pages show runs, one page after the other, in the tutorial's folder."""

import re
from pathlib import Path

import pytest

import elastocal as ec
from elastocal.simulation import run_demo

DOCS = Path(__file__).parents[2] / "docs"
# In the order in which they build on each other; design and diagnosis have tests of their own.
PAGES = ("input", "model", "identification", "simulation")


def examples(page):
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


def test_the_examples_run(course, monkeypatch, capsys):
    monkeypatch.chdir(course.folder)
    names = {}
    for page in PAGES:
        (example,) = examples(DOCS / "reference" / "api" / f"{page}.md")
        exec(compile(example, page, "exec"), names)
    assert "joint4.compliance" in capsys.readouterr().out
    assert len(names["simulated"]) == 8 * 2 * 3 * 3  # poses, load states, repeats, markers
    (example,) = examples(DOCS / "identifying.md")
    exec(compile(example, "identifying", "exec"), names)
    held = [e.name for e in names["fit"].estimates if not e.identifiable]
    assert held == ["joint1.compliance"]


def test_the_front_door_is_as_its_page_shows_it(course, monkeypatch, capsys):
    monkeypatch.chdir(course.folder)
    (example,) = examples(DOCS / "reference" / "api" / "front.md")
    exec(compile(example, "front", "exec"), {})
    assert "<Calibration" in capsys.readouterr().out
    assert {"front.csv", "calibrated.urdf"} <= {path.name for path in course.folder.iterdir()}


def test_the_readme_s_first_screen_runs_and_its_numbers_are_those_found(tmp_path, monkeypatch):
    (example,) = examples(DOCS.parent / "README.md")
    assert "B_i" in (DOCS.parent / "README.md").read_text(encoding="utf-8").split("```", 1)[0]
    run_demo(tmp_path / "demo_out")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(example, "README", "exec"), names)
    low, high = names["fit"]["joint3.compliance"].ci95
    assert f"({low:.3e}, {high:.3e})" in example and str(names["B"].shape) in example
    (efficiency,) = re.findall(r"efficiency_pool +# ([0-9.]+):", example)
    assert f"{names['fit'].residuals.shape[0]} deflections × 3 directions" in example
    (pool,) = re.findall(r"pool of ([0-9]+) poses", example)
    assert names["plan"].certificate.pool == pytest.approx(int(pool), rel=0.02)
    # Which of several polished plans of nearly one worth is found, rounding decides.
    assert names["plan"].certificate.efficiency_pool == pytest.approx(float(efficiency), abs=2e-3)
    written = {path.name for path in tmp_path.iterdir()}
    assert {"report.html", "commands.csv", "calibrated.urdf", "plan.csv"} <= written


def test_every_name_of_the_front_door_that_a_page_uses_is_there():
    used = {
        name
        for page in [DOCS.parent / "README.md", *DOCS.rglob("*.md")]
        for example in examples(page)
        for name in re.findall(r"\bec\.(\w+)", example)
    }
    assert {"Model", "identify", "design", "diagnose"} <= used <= set(ec.__all__)


def test_the_page_of_the_front_door_has_every_name():
    page = (DOCS / "reference" / "api" / "front.md").read_text(encoding="utf-8")
    shown = re.findall(r"^::: elastocal\.(\w+)$", page, re.M)
    assert sorted(shown) == sorted(ec.__all__)
