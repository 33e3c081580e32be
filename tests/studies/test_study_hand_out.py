"""Tasks handed to workers that die: who is out, who is tried again, and who is blamed."""

import threading
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest
from support.study_folders import SCRIPT, TOML, numbers, on_processes, run_study, write_study

from elastocal.studies.study_folder import Outcome, read_study
from elastocal.studies.study_run import StudyStop, hand_out


class PretendedCrew:
    """Three places that work a moment after the last task went out; `lethal` tasks kill the
    process of everything that is out, `broken` ones fail on their way to the worker."""

    tries = 3

    def __init__(self, lethal=(), broken=()):
        self.lethal, self.broken = lethal, broken
        self.out, self.together, self.closed = {}, [], False
        self.begin = threading.Timer(0, self.work)

    def places(self):
        return 3

    def submit(self, function, sources, task):
        self.begin.cancel()
        future = Future()
        self.out[future] = task
        self.begin = threading.Timer(0.2, self.work)
        self.begin.start()
        return future

    def work(self):
        held, self.out = self.out, {}
        indices = sorted(task.index for task in held.values())
        self.together.append(indices)
        for future, task in held.items():
            if set(indices) & set(self.lethal):
                future.set_exception(BrokenProcessPool("died"))
            elif task.index in self.broken:
                future.set_exception(ImportError("no module of this name"))
            else:
                future.set_result(Outcome(task.index, ({"mean": 0.0},)))

    def deaths(self, error):
        return int(isinstance(error, BrokenProcessPool))

    def close(self, out):
        self.closed = True


@pytest.fixture
def study(tmp_path):
    return read_study(write_study(tmp_path / "study"))


def handed_out(study, crew, stop=None):
    return list(hand_out(crew, study.sources, study.tasks, stop or StudyStop()))


def test_all_come_back_once_and_no_more_are_out_than_there_are_places(study):
    crew = PretendedCrew()
    assert sorted(outcome.index for outcome in handed_out(study, crew)) == list(range(12))
    assert max(map(len, crew.together)) <= 3 and crew.closed


def test_those_out_beside_one_that_kills_are_tried_again_alone_and_not_blamed(study):
    crew = PretendedCrew(lethal={4})
    outcomes = {outcome.index: outcome for outcome in handed_out(study, crew)}
    assert sorted(outcomes) == list(range(12))
    assert [index for index, outcome in outcomes.items() if outcome.error] == [4]
    assert outcomes[4].error.startswith("its worker process died 3 times (out of memory")
    first = next(k for k, together in enumerate(crew.together) if 4 in together)
    beside = set(crew.together[first]) - {4}
    alone = [together for together in crew.together[first + 1 :] if {4, *beside} & set(together)]
    assert beside and sorted(alone) == sorted([[4], [4], *([index] for index in beside)])


def test_a_task_that_never_reaches_its_worker_fails_at_once(study):
    crew = PretendedCrew(broken={7})
    outcomes = {outcome.index: outcome for outcome in handed_out(study, crew)}
    assert [index for index, outcome in outcomes.items() if outcome.error] == [7]
    assert "could not run it: ImportError: no module" in outcomes[7].error
    assert sum(7 in together for together in crew.together) == 1


def test_nothing_goes_out_after_a_stop_not_even_a_second_try(study):
    crew, stop = PretendedCrew(lethal={1}), StudyStop()
    done = []
    for outcome in hand_out(crew, study.sources, study.tasks, stop):
        done.append(outcome.index)
        stop.asked = True
    assert crew.together == [[0, 1, 2], [3, 4, 5]] and crew.closed
    assert sorted(done) == [3, 4, 5]


def test_workers_share_the_cores_unless_the_environment_says_otherwise(tmp_path, monkeypatch):
    import joblib

    script = SCRIPT[: SCRIPT.index('    return [{"mean"')] + (
        "    import os\n"
        '    return {"mean": float(os.environ["MKL_NUM_THREADS"]),\n'
        '            "above": int(os.environ["OMP_NUM_THREADS"])}\n'
    )
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    folder = write_study(tmp_path / "study", script, TOML)
    run_study(folder, tmp_path / "r", lambda study: on_processes(study, 2))
    frame = numbers(tmp_path / "r")
    assert set(frame["above"]) == {5} and set(frame["mean"]) == {max(joblib.cpu_count() // 2, 1)}
