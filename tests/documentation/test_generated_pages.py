"""Pages that are made from the code have all of it."""

import re

import commands_page
import criteria_page
import effects_page
import measured_page
import pytest
import typer

from elastocal.__main__ import commands
from elastocal.model.effects.base import Effect
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.planning.criteria import CRITERIA


@pytest.fixture(scope="module")
def effects() -> str:
    """Made where it is looked at: every process that collects the tests would make it."""
    return effects_page.page()


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_has_text_places_and_columns(effects, name):
    part = effects.split(f"### `{name}` ", 1)[1].split("\n### ", 1)[0]
    first = CATALOGUE[name].__class__.__doc__.strip().splitlines()[0]
    assert first in part and first != Effect.__doc__.splitlines()[0]
    assert re.search(r"- \*\*Places\*\*: `", part)
    assert "- **Columns that it needs**: " in part
    assert "| parameter | unit |" in part or "No parameters." in part


@pytest.mark.parametrize("name", CRITERIA)
def test_every_criterion_says_what_it_is_and_whether_it_has_a_bound(name):
    page = criteria_page.page()
    criterion = CRITERIA[name]
    row = next(line for line in page.splitlines() if line.startswith(f"| [`{name}`]"))
    assert criterion.title and criterion.title in row
    assert row.endswith("yes |" if criterion.certifiable else "no |")
    part = page.split(f"## `{name}` ", 1)[1].split("\n## ", 1)[0]
    assert criterion.__doc__.strip().splitlines()[0] in part
    assert ("**No bound**" in part) != criterion.certifiable


def test_every_verb_and_option_is_on_the_page():
    page = commands_page.page()
    for name, command in typer.main.get_command(commands()).commands.items():
        part = page.split(f"\n## {name}\n", 1)[1].split("\n## ", 1)[0]
        for parameter in command.params:
            shown = parameter.opts[-1] if parameter.param_type_name == "option" else parameter.name
            assert f"`{shown.upper()}`" in part or f"`{shown}`" in part, f"{name}: {shown}"


def test_the_measured_pages_are_what_the_studies_wrote():
    for path, text in measured_page.pages().items():
        assert path.read_text(encoding="utf-8") == text, "run python docs/scripts/measured_page.py"
