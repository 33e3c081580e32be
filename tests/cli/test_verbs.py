"""What every verb owes: its line in --help, inputs that are kept, options that are checked."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from elastocal.cli.app import VERBS
from elastocal.cli.main import app


def run(*arguments: str):
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


def test_help_lists_every_verb_in_the_order_of_the_work_with_a_whole_sentence():
    shown = run("--help").stdout.partition("Commands:")[2].strip().splitlines()
    assert [line.split()[0] for line in shown] == list(VERBS)
    for line in shown:
        assert len(line.split()) > 3 and not line.endswith("..."), line


@pytest.mark.parametrize("verb", VERBS)
def test_no_help_text_shows_what_only_a_programmer_knows(verb: str) -> None:
    options = run(verb, "--help").stdout.partition("Options:")[2]
    assert "list[" not in options and "float,float" not in options
    assert all(line.split()[0].startswith("--frames") for line in options.splitlines()
               if " / " in line.partition("  ")[2])  # fmt: skip
