"""The numbers of a study depend on its seed and tasks alone; its results are whole lines."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.study_folders import SCRIPT, TOML, here, numbers, on_processes, run_study, write_study

from elastocal.messages import InputError
from elastocal.studies import load, opened, read_results, read_study
from elastocal.studies import run_study as run_prepared

PAGE = Path(__file__).parents[2] / "docs" / "studies.md"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("numbers") / "study")


@pytest.fixture(scope="module")
def whole(small):
    results = small.parent / "whole"
    assert run_study(small, results).done == 12
    return numbers(results)


def test_they_depend_on_the_seed_and_not_on_the_number_of_processes(small, whole, tmp_path):
    ending = run_study(small, tmp_path / "two", lambda study: on_processes(study, 2))
    assert (ending.done, ending.failed, ending.complete) == (12, 0, True)
    pd.testing.assert_frame_equal(numbers(tmp_path / "two"), whole)
    run_study(small, tmp_path / "other", seed=12)
    assert not np.isclose(numbers(tmp_path / "other")["mean"], whole["mean"]).any()


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.randoms(use_true_random=False), st.lists(st.integers(0, 7), max_size=4))
def test_they_depend_neither_on_order_nor_on_interruptions(
    small, whole, tmp_path_factory, random, cuts
):
    results = tmp_path_factory.mktemp("cut")

    def shuffled(jobs):
        random.shuffle(jobs)
        return jobs

    for cut in cuts:
        run_study(small, results, lambda study, cut=cut: here(study, shuffled, cut))
    assert run_study(small, results, lambda study: here(study, shuffled)).complete
    pd.testing.assert_frame_equal(numbers(results), whole)


@pytest.fixture
def folder(tmp_path):
    return write_study(tmp_path / "study")


@pytest.fixture
def results(folder):
    run_study(folder, folder / "results")
    return folder / "results"


def test_results_that_are_damaged_or_there_twice_are_named(results):
    path = results / "results.jsonl"
    first, rest = path.read_text("utf-8").split("\n", 1)
    twice, cut = f"{first}\n{rest}{first}\n", f"{first}\n{{cut\n{rest}"
    for text, told in ((twice, "task 0 has more than one result"), (cut, "line 2: is damaged")):
        path.write_text(text, "utf-8")
        with pytest.raises(InputError, match=told):
            read_results(results)


def test_two_runs_cannot_write_at_once(tmp_path):
    results = tmp_path / "r"
    with opened(results), pytest.raises(InputError, match="another run"), opened(results):
        pass
    with opened(results):
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


def test_the_study_shown_runs(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```", text, re.S).group(1)
    toml = re.search(r"```toml\n(.*?)```", text, re.S).group(1)
    folder = write_study(tmp_path / "repeats", script, toml)
    ending = run_study(folder, tmp_path / "r", only=1)
    assert (ending.done, ending.failed) == (1, 0)
    frame = read_results(tmp_path / "r")
    assert frame["error"].abs().max() < 1.0  # µrad/(N·m)
    assert load(read_study(folder).sources).summary(frame).startswith("| readings per pose |")
