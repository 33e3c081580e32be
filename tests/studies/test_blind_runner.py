"""The blind check's runner: nothing leaks, nothing is lost or done twice, the score is the rule."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "blind_diagnosis"
sys.path.insert(0, str(FOLDER))

import one_world
import score
import suites
import worker
from draw import Recipe
from support.study_scripts import study_of

study = study_of(FOLDER)
ECCENTRIC, MASS = ("gear_eccentricity", "joint2"), ("link_mass_error", "link2")
SCALE, BACKLASH = ("encoder_scale", "joint3"), ("backlash", "joint2")
TRUTH = {
    "effects": [{"effect": "gear_eccentricity", "where": "joint2", "values": {"size": 1.0}}],
    "arm_values": {"joint_offset_rad": [0.0] * 6},
}


def answer(verdict, *found, sets=()):
    def placed(pair):
        return {"effect": pair[0], "where": pair[1]}

    return {
        "verdict": verdict,
        "effects": [placed(p) | {"probability": 0.95} for p in found],
        "indistinguishable": [[placed(p) for p in members] for members in sets],
        "location": None,
    }


NOTHING = answer("nothing_significant")


# --- what is right ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "outcome", "outright"),
    [
        (answer("explained", ECCENTRIC), "right", True),
        (answer("explained", ("gear_eccentricity", "joint3")), "wrong", False),
        (answer("explained", MASS), "wrong", False),
        (answer("explained", ECCENTRIC, SCALE), "wrong", False),
        (answer("ambiguous", MASS, sets=[[MASS, ECCENTRIC]]), "right", False),
        (answer("ambiguous", MASS, sets=[[MASS, SCALE, ECCENTRIC]]), "right", False),
        (answer("ambiguous", MASS, sets=[[MASS, SCALE, BACKLASH, ECCENTRIC]]), "vague", False),
        (answer("ambiguous", MASS, sets=[[MASS, SCALE]]), "wrong", False),
        (answer("ambiguous", ECCENTRIC, MASS, sets=[[MASS, SCALE]]), "wrong", False),
        (answer("unknown_effect", ECCENTRIC), "unknown", False),
        (NOTHING, "nothing", False),
        (None, "failed", False),
    ],
)
def test_one_effect(given, outcome, outright):
    assert score.one_effect(TRUTH, given) == outcome
    assert score.outright(TRUTH, given) is outright


# --- nothing leaks, nothing is lost -----------------------------------------------------------


def test_the_tool_sees_neither_the_truth_nor_a_name_that_betrays_it(monkeypatch):
    folders, make, observed = [], one_world.tempfile.mkdtemp, []

    def made(**given):
        folders.append(Path(make(**given)))
        return str(folders[-1])

    def blindfold(folder, *arguments):
        """Answers without the tool, and looks around in what it was given."""
        observed.append((folder, arguments, sorted(p.name for p in folder.iterdir())))
        given = dict.fromkeys(score.KEPT) | NOTHING | {"candidates": [{}] * 99}
        (folder / one_world.ANSWER).write_text(json.dumps(given))
        return worker.Run(0, 1.0, "")

    monkeypatch.setattr(one_world.tempfile, "mkdtemp", made)
    monkeypatch.setattr(one_world, "run", blindfold)
    monkeypatch.setattr(one_world, "tested", lambda folder, cell: len(cell))
    recipe = Recipe("encoder_scale-8-000", (5, 1), ("encoder_scale",), poses=8)
    record = one_world.diagnose_world(suites.Task("left_out", recipe), {"seed": 5})
    (visible, arguments, files), (_, whole, _) = observed
    sealed = next(f for f in folders if f != visible)
    assert files == ["arm.urdf", "cell.toml", "data.csv"]
    written = ("-o", one_world.ANSWER, "--cell-out", one_world.CELL)
    assert arguments == (*one_world.DIAGNOSE, *written, "--without", "encoder_scale")
    assert "--without" not in whole and record["dearer"] == len(one_world.CELL) / len("all.toml")
    assert not visible.is_relative_to(sealed) and not sealed.is_relative_to(visible)
    assert "encoder" not in str(visible) and visible.name[:6] != sealed.name[:6]
    assert record["truth"]["effects"][0]["effect"] == "encoder_scale"
    assert len(record["answer"]["candidates"]) == score.CANDIDATES
    assert not visible.exists() and not sealed.exists()


def test_the_command_is_given_no_environment_and_cannot_import_the_study(tmp_path, monkeypatch):
    """A stand-in for it tells what a process of its kind can reach."""
    probe = (
        "import importlib.util, json, os, sys\n"
        "told = [sorted(os.environ), importlib.util.find_spec('draw') is None, os.getcwd()]\n"
        "sys.exit(json.dumps(told))"
    )
    monkeypatch.setattr(worker, "COMMAND", (*worker.COMMAND[:2], "-c", probe))
    monkeypatch.setenv("SEED_OF_THE_STUDY", "5")
    monkeypatch.setenv("PYTHONPATH", str(FOLDER))
    environment, cannot_import, cwd = json.loads(worker.run(tmp_path).message)
    assert set(environment) <= {*worker.KEPT, "OPENBLAS_NUM_THREADS", "LC_CTYPE"}
    assert cannot_import and Path(cwd) == tmp_path


# --- the study ---------------------------------------------------------------------------------


OPTIONS = dict.fromkeys({name.partition("-")[0] for name in suites.SUITES}, 1)


def test_a_task_is_the_suites_world_of_that_name_under_the_studys_seed(monkeypatch):
    """A part of a study draws the same worlds.  The first and the last of every suite."""
    drawn = []

    def one(task, origin):
        drawn.append(task)
        return origin | {"suite": task.suite, "answer": None, "seconds": 1.0}

    monkeypatch.setattr(study, "diagnose_world", one)
    every = list(study.tasks(OPTIONS))
    ends = [{given["suite"]: given for given in order} for order in (every, every[::-1])]
    chosen = [given for end in ends for given in end.values()]
    for k, given in enumerate(chosen):
        rng = np.random.default_rng(np.random.SeedSequence(7, spawn_key=(k,)))
        assert json.loads(study.run(given, rng)["record"])["seed"] == 7
    whole = [task for suite in suites.SUITES for task in suites.tasks(suite, 7, 1)]
    found = {(task.suite, task.recipe.name): task for task in whole}
    assert sorted(found) == sorted((given["suite"], given["world"]) for given in every)
    assert drawn == [found[given["suite"], given["world"]] for given in chosen]
    two = [t["world"] for t in study.tasks(OPTIONS | {"catalogue": 2}) if t["suite"] == "catalogue"]
    assert two[: len(two) // 2] == [t.recipe.name for t in whole if t.suite == "catalogue"]
    fewer = list(study.tasks(OPTIONS | {"catalogue": 0, "clean": 0}))
    assert {t["suite"] for t in fewer} == {
        name for name in suites.SUITES if name != "catalogue" and "clean" not in name
    }
