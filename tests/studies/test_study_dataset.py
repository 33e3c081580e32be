"""The results on disk: one writer, whole lines, nothing twice, readable by others."""

import json

import pandas as pd
import pytest
from support.study_folders import SCRIPT, TOML, numbers, run_study, write_study

from elastocal.errors import InputError
from elastocal.studies import opened, read_results, read_study
from elastocal.studies import run_study as run_prepared


@pytest.fixture
def folder(tmp_path):
    return write_study(tmp_path / "study")


@pytest.fixture
def results(folder):
    run_study(folder, folder / "results")
    return folder / "results"


def test_a_result_that_is_there_twice_is_refused_on_reading(results):
    lines = (results / "results.jsonl").read_text("utf-8")
    (results / "results.jsonl").write_text(lines + lines.partition("\n")[0] + "\n", "utf-8")
    with pytest.raises(InputError, match="task 0 has more than one result"):
        read_results(results)


def test_a_damaged_line_is_named(results):
    first, rest = (results / "results.jsonl").read_text("utf-8").split("\n", 1)
    (results / "results.jsonl").write_text(f"{first}\n{{cut\n{rest}", "utf-8")
    with pytest.raises(InputError, match=r"results.jsonl, line 2: is damaged"):
        read_results(results)


def test_two_runs_cannot_write_at_once(tmp_path):
    results = tmp_path / "r"
    with opened(results), pytest.raises(InputError, match="another run"), opened(results):
        pass
    with opened(results):
        pass


def test_a_folder_with_other_things_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds thesis\.txt"), opened(tmp_path):
        pass


def test_what_a_killed_run_left_half_written_is_computed_again(folder, results):
    before, path = numbers(results), results / "results.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    ending = run_study(folder, results)
    assert (ending.before, ending.done) == (11, 12)
    pd.testing.assert_frame_equal(numbers(results), before)


def test_each_line_is_strict_json_whatever_a_task_returns(tmp_path):
    script = SCRIPT[: SCRIPT.index('    return [{"mean"')]
    script += "    return [{'mean': float(v)} for v in ('nan', '-inf', 2)]\n"
    folder = write_study(tmp_path / "study", script)
    run_study(folder, tmp_path / "r", only=1)

    def refuse(name):
        raise AssertionError(name)

    json.loads((tmp_path / "r" / "results.jsonl").read_text("utf-8"), parse_constant=refuse)
    mean = read_results(tmp_path / "r")["mean"]
    assert pd.isna(mean[0]) and mean[1] == float("-inf") and mean[2] == 2


@pytest.mark.parametrize(
    ("script", "toml", "told"),
    [
        (SCRIPT.replace("x.max()", "x.min()"), TOML, "study.py changed since"),
        (SCRIPT, TOML.replace("seed = 11", "seed = 5"), "the seed was 11, now it is 5"),
        (SCRIPT, TOML.replace("replicates = 6", "replicates = 5"), "option replicates was 6"),
        (SCRIPT, TOML.replace('"mm"', '"m"'), "other columns, types or units"),
    ],
)
def test_results_of_another_study_are_refused(folder, results, script, toml, told):
    before = numbers(results)
    write_study(folder, script, toml)
    with pytest.raises(InputError, match=told) as refused:
        run_study(folder, results)
    assert "restart=True" in str(refused.value)
    pd.testing.assert_frame_equal(numbers(results), before)


def test_a_cluster_that_cannot_be_reached_costs_no_results(folder, results, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr("elastocal.studies.ANSWER", 0.5)
    with pytest.raises(InputError, match="no scheduler answers"):
        run_prepared(read_study(folder), results, cluster="tcp://127.0.0.1:9", restart=True)
    assert len(numbers(results)) == 24
