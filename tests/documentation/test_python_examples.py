"""The Python that the pages show runs, one page after the other, in the tutorial's folder."""

import re
from pathlib import Path

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
    held = [e.name for e in names["result"].estimates if not e.identifiable]
    assert held == ["joint1.compliance"]


def test_the_examples_of_design_and_diagnosis_name_what_exists():
    for page in ("design", "diagnosis"):
        (example,) = examples(DOCS / "reference" / "api" / f"{page}.md")
        imports = [line for line in example.splitlines() if line.startswith("from ")]
        assert imports
        exec(compile("\n".join(imports), page, "exec"), {})
        compile(example, page, "exec")
