"""What the documentation shows is what the tool accepts."""

import re
import shlex
from pathlib import Path

import pytest
import typer
from support.robots import KR270

from elastocal.__main__ import commands
from elastocal.cell import read_cell
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SCREEN = 62  # lines
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
# Made from the code when the site is built; tests/documentation/test_generated_pages.py has them.
GENERATED = {
    DOCS / "reference" / f"{name}.md" for name in ("effects", "commands", "criteria", "cell-keys")
}


def toml_blocks(page: str) -> list[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"```toml\n(.*?)```", text, re.S)


def test_every_cell_shown_is_a_cell(tmp_path):
    blocks = toml_blocks("README.md") + toml_blocks("docs/file-formats.md")
    assert len(blocks) == 2
    (design,) = re.findall(
        r"```toml design\n(.*?)```", (DOCS / "designing.md").read_text(encoding="utf-8"), re.S
    )
    (tmp_path / "arm.urdf").write_text(KR270.read_text(encoding="utf-8"), encoding="utf-8")
    first = blocks[0].partition("[design]")[0]
    assert "loads_N" in blocks[0] and "[workspace]" in blocks[0]
    for block in [*blocks, first + design]:
        path = tmp_path / "cell.toml"
        path.write_text(block, encoding="utf-8")
        model = Model(read_cell(path, known_effects=tuple(CATALOGUE)))
        assert model.parameters


def test_each_part_of_the_readme_fits_a_screen():
    parts = re.split(r"^##+ ", PAGES[0].read_text(encoding="utf-8"), flags=re.M)
    heads = [part.partition("\n")[0] for part in parts]
    assert {"The three answers", "Measured", "Limitations"} <= set(heads)
    assert {head: n for head, part in zip(heads, parts, strict=True)
            if (n := part.count("\n")) > SCREEN} == {}  # fmt: skip


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)", page.read_text(encoding="utf-8")):
            where = (page.parent / target).resolve()
            assert where.exists() or where in GENERATED, f"{page.name} links to {target}"


COMMANDS = typer.main.get_command(commands()).commands


def commands_shown(page: Path) -> list[list[str]]:
    """Every `elastocal VERB …` of a page's blocks, split as a shell splits it."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^(?:    |\$ )(?:.* )?elastocal ([a-z]+ .*)$", text, re.M)
    found = [shlex.split(line.partition("#")[0].partition("&")[0]) for line in lines]
    return [words for words in found if words[0] in COMMANDS]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_shown_has_the_options_it_is_shown_with(page):
    for verb, *words in commands_shown(page):
        known = {name for p in COMMANDS[verb].params for name in (*p.opts, *p.secondary_opts)}
        options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert options <= known | {"--help"}, f"{page.name}: elastocal {verb}"


def test_every_figure_is_there_for_light_and_for_dark_pages():
    for page in PAGES:
        shown = re.findall(
            r"\(\S*images/(\w+)_(light|dark)\.svg#only-(light|dark)\)", page.read_text()
        )
        assert all(scheme == only for _, scheme, only in shown)
        for name in {name for name, _, _ in shown}:
            assert {only for other, _, only in shown if other == name} == {"light", "dark"}
            assert (DOCS / "figures" / f"{name}.py").exists(), f"no script makes {name}"


def test_every_file_of_the_repository_that_a_page_names_is_there():
    folders = "|".join(("src", "tests", "docs", "examples", "experiment_design", "benchmarks"))
    for page in [*PAGES, *ROOT.glob("experiment_design/*/README.md")]:
        for name in re.findall(rf"`((?:{folders})/[^`\s*]*)", page.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_the_readme_is_read_in_ten_minutes():
    """1,200 words with its tables; blocks of code count for nothing."""
    text = re.sub(r"```.*?```", "", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.S)
    assert len(text.split()) <= 1200
    assert [name for name in ("make demo", "make test", "pip install .") if name not in text] == []
