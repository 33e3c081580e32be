"""What every verb owes: its line in --help, inputs that are kept, options that are checked."""

from __future__ import annotations

from pathlib import Path

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


def test_an_option_without_effect_is_taken_and_not_offered() -> None:
    assert "--jobs" not in run("identify", "--help").stdout
    assert "--jobs" in run("design", "--help").stdout
    done = run("identify", "no.toml", "no.csv", "--jobs", "2")
    assert done.exit_code == 2 and "no.toml: no such file" in done.stderr


@pytest.mark.parametrize("verb", VERBS)
def test_no_help_text_shows_what_only_a_programmer_knows(verb: str) -> None:
    options = run(verb, "--help").stdout.partition("Options:")[2]
    assert "list[" not in options and "float,float" not in options
    assert all(line.split()[0].startswith("--frames") for line in options.splitlines()
               if " / " in line.partition("  ")[2])  # fmt: skip


@pytest.mark.parametrize(
    "words",
    [
        "identify data.csv cell.toml", "diagnose data.parquet cell.toml", "design plan.csv -o p",
        "simulate plan.csv cell.toml -o d.csv", "next data.csv cell.toml -o n.csv",
        "compensate result.json cell.toml --target 1,2,3", "export result.json cell.toml -o a.urdf",
        "compare old.json new.json cell.toml", "effects data.csv",
    ],
)  # fmt: skip
def test_a_cell_file_in_anothers_place_is_told_so(words: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = words.split()[1]
    for name in ("data.csv", "cell.toml", "plan.csv", "data.parquet", "result.json", "new.json"):
        (tmp_path / name).write_text("x,y\n1,2\n")
    done = run(*words.split())
    ending = first[first.rindex(".") :]
    assert done.exit_code == 2 and not done.stdout
    assert f"elastocal: {first}: ends in {ending}, where the cell file" in done.stderr
    assert "the cell file (.toml) comes first" in " ".join(done.stderr.split())


def test_a_second_cell_file_is_no_table_and_no_result(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[1] / "golden" / "inputs" / "campaign")
    for words in ("identify placed.toml placed.toml", "simulate placed.toml placed.toml -o",
                  "compensate placed.toml placed.toml targets.csv -o"):  # fmt: skip
        told = run(*words.replace("-o", f"-o {tmp_path}/out.csv").split())
        assert told.exit_code == 2 and "ends in .toml, where the" in told.stderr
