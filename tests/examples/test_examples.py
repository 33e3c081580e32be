"""The examples run from end to end in a folder of their own, and what they say is true."""

import json
import runpy
from pathlib import Path

import matplotlib
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOKS = sorted(path.stem for path in EXAMPLES.glob("*.ipynb"))


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(matplotlib.rcParams, "backend", "Agg", raising=False)


def script(name):
    return runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


def notebook(name):
    """The names that a notebook's code leaves behind, its cells run with few candidates."""
    names = {}
    for number, source in enumerate(cells(name, "code")):
        source = source.replace("candidates=500", "candidates=60")
        exec(compile(source, f"{name}.ipynb, cell {number}", "exec"), names)
    return names


def cells(name, kind):
    made = json.loads((EXAMPLES / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in made if cell["cell_type"] == kind]


def test_the_paper_on_one_page(capsys):
    found = script("klimchik2013")
    true = np.array(
        [found["truth"][name] for name in np.array(found["model"].names)[found["shown"]]]
    )
    plain, weighted, once = found["plain"], found["weighted"], found["once"]
    assert found["B"].shape == (810, 9)
    for fit in (plain, weighted, once):
        assert (np.abs(fit.x - true) < 3.5 * fit.std).all()
    assert (weighted.std < 0.8 * plain.std).all()  # what eq. (13) gains over eq. (7)
    assert (weighted.std < once.std).all()  # no weights are better than the true ones
    plan = found["plan"]
    assert plan.bound_reported <= plan.reported < plan.chance.median
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 2 + 9 + 2 and printed[2].startswith("joint2.compliance_level1")


def test_a_cell_built_in_python():
    found = script("cell_in_python")
    for name, value in found["truth"].items():
        estimate = found["fit"][name]
        assert abs(estimate.value - value) < 4 * estimate.std
    assert found["cell"].path is None


def test_identify():
    found = notebook("identify")
    assert not found["B"][:, 0].any() and not found["fit"]["joint1.compliance"].identifiable
    assert found["known"]["inside"].mean() > 0.7
    assert found["fit"].test.rms < 40e-6
    assert found["commands"].after.max() < 1e-9 < found["commands"].before.max()
    assert written() == {"result.json", "parameters.yaml", "report.html"}


def test_design():
    found = notebook("design")
    plan = found["plan"]
    assert 0.9 < plan.certificate.efficiency_pool <= 1
    assert plan.bound_reported <= plan.reported < plan.chance.median
    for promised in plan.predicted:
        assert found["fit"][promised.name].std == pytest.approx(promised.std, rel=0.2)
    assert {"plan.csv", "plan.html"} <= written()


def test_diagnose():
    found = notebook("diagnose")
    why, better = found["why"], found["better"]
    assert why.verdict == "explained"
    assert [(effect.effect, effect.where) for effect in why.effects] == [("backlash", "joint3")]
    low, high = better["joint3.backlash"].ci95
    assert low < found["values"]["joint3.backlash"] < high
    assert written() == {"diagnosis.json", "diagnosis.html"}


def written():
    return {path.name for path in Path().iterdir()}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_are_of_format_4_without_outputs_and_with_text(name):
    made = json.loads((EXAMPLES / f"{name}.ipynb").read_text(encoding="utf-8"))
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])
    for cell in made["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
    assert cells(name, "markdown")[0].startswith("# ")
