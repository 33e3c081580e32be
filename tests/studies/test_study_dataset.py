"""The results on disk: one writer, whole parts, nothing twice, readable by others."""

import shutil
import time

import pandas as pd
import pyarrow.parquet as pq
import pytest
from support.study_folders import SCRIPT, TOML, here, numbers, run_study, write_study

from elastocal.errors import InputError
from elastocal.studies import study_results
from elastocal.studies.study_folder import execute, read_study
from elastocal.studies.study_results import Recorder, StudyResults, opened, read_results
from elastocal.studies.study_run import run_study as run_prepared


@pytest.fixture
def folder(tmp_path):
    return write_study(tmp_path / "study")


@pytest.fixture
def results(folder):
    run_study(folder, folder / "results")
    return folder / "results"


def test_others_read_the_folder_as_one_dataset_with_units(results):
    frame = pd.read_parquet(results)
    assert len(frame) == 24 and set(frame["label"]) == {"few", "many"}
    schema = pq.read_schema(results / "part-000001.parquet")
    assert schema.field("mean").metadata[b"unit"] == b"mm"
    types = [str(schema.field(name).type) for name in ("inside", "above", "n")]
    assert types == ["bool", "int64", "int64"]


def test_a_result_that_is_there_twice_is_refused_on_reading(results):
    shutil.copy(results / "part-000001.parquet", results / "part-000002.parquet")
    with pytest.raises(InputError, match="task 0 has more than one result"):
        read_results(results)


def test_a_damaged_part_is_named(results):
    (results / "part-000001.parquet").write_bytes(b"PAR1 cut")
    with pytest.raises(InputError, match=r"part-000001.parquet: damaged"):
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


def test_what_a_killed_run_left_half_written_is_removed(folder, results):
    left = results / ".part-000002.parquet.0123abcd.tmp"
    left.write_bytes(b"PAR1")
    assert run_study(folder, results).complete
    assert not left.exists()


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


@pytest.mark.parametrize(
    ("name", "told"), [("task_row", "cannot be a column"), ("label", "also a value of the tasks")]
)
def test_a_column_of_a_taken_name_is_refused(tmp_path, name, told):
    folder = write_study(tmp_path / "study", SCRIPT, f'{TOML}{name} = ""\n')
    with pytest.raises(InputError, match=f"columns.{name} .*{told}"):
        run_study(folder, tmp_path / "r")


def test_values_of_no_common_type_come_back_as_they_were(tmp_path):
    tasks = '[{"n": 4, "at": [1, 2.5]}, {"n": 4, "at": "x"}, {"n": 4}]'
    script = SCRIPT.replace('[{"n": n, "label"', f'{tasks} or [{{"n": n, "label"')
    folder = write_study(tmp_path / "study", script)
    run_study(folder, tmp_path / "r")
    assert list(read_results(tmp_path / "r")["at"])[::2] == [[1, 2.5], "x", None]
    assert set(pd.read_parquet(tmp_path / "r")["at"]) == {"[1, 2.5]", '"x"', "null"}
    assert run_study(folder, tmp_path / "r").before == 3


def test_a_finished_study_needs_no_cluster(folder, results):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    ending = run_prepared(read_study(folder), results, cluster="tcp://127.0.0.1:9")
    assert (ending.before, ending.done) == (12, 12)


def test_a_cluster_that_cannot_be_reached_costs_no_results(folder, results, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr("elastocal.studies.study_run.ANSWER", 0.5)
    with pytest.raises(InputError, match="no scheduler answers"):
        run_prepared(read_study(folder), results, cluster="tcp://127.0.0.1:9", restart=True)
    assert len(numbers(results)) == 24


def test_a_part_of_another_name_is_read_and_not_written_over(folder, results):
    (results / "part-000001.parquet").rename(results / "part-elsewhere.parquet")
    assert run_study(folder, results).before == 12 and len(numbers(results)) == 24


def test_more_tasks_of_the_same_kind_at_the_end_go_on(tmp_path):
    script = SCRIPT.replace("for n in (4, 16) for k", "for k").replace('"n": n', '"n": 4 + k')
    script = script.replace('"few" if n < 9 else "many"', '"any"')
    folder = write_study(tmp_path / "study", script)
    run_study(folder, tmp_path / "r")
    write_study(folder, script, TOML.replace("replicates = 6", "replicates = 9"))
    ending = run_study(folder, tmp_path / "r")
    assert (ending.before, ending.done) == (6, 9)


def outcomes_of(folder, results):
    study = read_study(folder)
    results.mkdir()
    return StudyResults(results), study, [execute(study.sources, task) for task in study.tasks]


def test_a_write_that_is_interrupted_is_made_again_and_nothing_is_twice(
    folder, tmp_path, monkeypatch
):
    dataset, study, outcomes = outcomes_of(folder, tmp_path / "r")
    write, calls = StudyResults.write, []

    def interrupted_after(self, part, lines):
        write(self, part, lines)
        calls.append(part.name)
        if len(calls) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(StudyResults, "write", interrupted_after)
    with pytest.raises(KeyboardInterrupt), Recorder(dataset, study, "0") as recording:
        for outcome in outcomes[:4]:
            recording.add(outcome)
        recording.flush()
    assert calls == ["part-000001.parquet"] * 2
    assert set(read_results(tmp_path / "r")["task"]) == {0, 1, 2, 3}


def test_a_result_is_written_although_the_next_one_takes_long(folder, tmp_path):
    dataset, study, outcomes = outcomes_of(folder, tmp_path / "r")
    with Recorder(dataset, study, "0", soonest=0.01) as recording:
        recording.add(outcomes[0])
        for _ in range(1000):
            if dataset.parts():
                break
            time.sleep(0.01)
        assert len(read_results(tmp_path / "r")) == 2
        recording.add(outcomes[1])
    assert len(read_results(tmp_path / "r")) == 4


def test_a_timed_write_that_fails_ends_the_run(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(study_results, "LATEST", 0.01)

    def full(self, part, lines):
        raise OSError(28, "No space left on device")

    def slowly(study):
        def runner(jobs):
            for outcome in here(study)(jobs):
                yield outcome
                time.sleep(0.05)

        return runner

    monkeypatch.setattr(StudyResults, "write", full)
    with pytest.raises(OSError, match="No space left"):
        run_study(folder, tmp_path / "r", slowly, soonest=0.01)
