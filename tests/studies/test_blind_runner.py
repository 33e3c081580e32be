"""The blind check's runner: nothing leaks, nothing is lost or done twice, the score is the rule."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("mujoco")
FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "blind_diagnosis"
sys.path.insert(0, str(FOLDER))

import afterwards
import bars
import extra_poses
import one_world
import records
import score
import suites
import worker
from calibration import calibration_error, draw_reliability, reliability
from draw import ALIKE, Recipe, draw_world
from power import CANDIDATES, LEVEL, power
from support.study_scripts import study_of
from visits import draw_poses
from world_files import write_world

from elastocal.studies.study_folder import read_study

study = study_of(FOLDER)
ECCENTRIC, MASS, SCALE = (
    ("gear_eccentricity", "joint2"),
    ("link_mass_error", "link2"),
    ("encoder_scale", "joint3"),
)


BACKLASHES = [("backlash", "joint2"), ("backlash", "joint3")]


def truth(*places, location=None, joints=6):
    effects = [{"effect": e, "where": w, "values": {"size": 1.0}} for e, w in places]
    if location:
        effects[0]["location"] = location
    return {"effects": effects, "arm_values": {"joint_offset_rad": [0.0] * joints}}


def answer(verdict, *found, sets=(), where=None, probability=0.95):
    def placed(pair):
        return {"effect": pair[0], "where": pair[1]}

    return {
        "verdict": verdict,
        "effects": [placed(p) | {"probability": probability} for p in found],
        "indistinguishable": [[placed(p) for p in members] for members in sets],
        "location": where and {"stage": "transmission", "where": where},
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
        (
            answer("ambiguous", MASS, sets=[[MASS, SCALE, ("backlash", "joint2"), ECCENTRIC]]),
            "vague",
            False,
        ),
        (answer("ambiguous", MASS, sets=[[MASS, SCALE]]), "wrong", False),
        (answer("ambiguous", ECCENTRIC, MASS, sets=[[MASS, SCALE]]), "wrong", False),
        (answer("unknown_effect", ECCENTRIC), "unknown", False),
        (NOTHING, "nothing", False),
        (None, "failed", False),
    ],
)
def test_one_effect(given, outcome, outright):
    assert score.one_effect(truth(ECCENTRIC), given) == outcome
    assert score.outright(truth(ECCENTRIC), given) is outright


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (answer("explained", ECCENTRIC), True),
        (answer("explained", MASS), False),
        (answer("ambiguous", MASS, sets=[[MASS, ECCENTRIC]]), True),
        (answer("ambiguous", MASS, sets=[[MASS, ECCENTRIC, SCALE]]), False),
        (answer("ambiguous", ECCENTRIC, sets=[[ECCENTRIC, SCALE]]), False),
        (answer("ambiguous", ECCENTRIC, MASS, sets=[[MASS, ECCENTRIC]]), False),
        (NOTHING, False),
        (None, False),
    ],
)
def test_a_plan_is_held_to_what_it_said_it_can_tell_apart(given, kept):
    plan = {"inseparable": [[":".join(ECCENTRIC), ":".join(MASS)]]}
    assert score.told_apart(truth(ECCENTRIC), plan, given) is kept
    assert not score.told_apart(truth(SCALE), plan, given)


def test_a_claim_is_the_set_that_its_own_finding_leads():
    given = answer("ambiguous", MASS, SCALE, sets=[[SCALE, MASS], [MASS, ECCENTRIC]])
    assert score.claims(given) == [[MASS, ECCENTRIC], [SCALE, MASS]]


@pytest.mark.parametrize(
    ("given", "found", "invented"),
    [
        (answer("explained", ECCENTRIC, SCALE), 2, 0),
        (answer("explained", SCALE, ECCENTRIC), 2, 0),
        (answer("explained", SCALE), 1, 0),
        (answer("explained", MASS, SCALE), 1, 1),
        (answer("explained", SCALE, ECCENTRIC, MASS), 2, 1),
        # A set of four finds nothing, and invents nothing where it holds a true effect.
        (answer("ambiguous", MASS, sets=[[MASS, SCALE, *BACKLASHES]]), 0, 0),
        (answer("ambiguous", MASS, sets=[[MASS, *BACKLASHES, *BACKLASHES]]), 0, 1),
        # One claim cannot stand for both.
        (answer("ambiguous", SCALE, sets=[[SCALE, ECCENTRIC]]), 1, 0),
        # The first claim holds both, the second only one of them: both are found.
        (answer("ambiguous", SCALE, ECCENTRIC, sets=[[SCALE, ECCENTRIC]]), 2, 0),
        (NOTHING, 0, 0),
        (None, 0, 0),
    ],
)
def test_two_effects(given, found, invented):
    assert score.pair(truth(ECCENTRIC, SCALE), given) == score.Pair(found, invented)


def test_alike_effects_are_reported_where_one_set_holds_both():
    def both(given):
        return score.both_reported(truth(ECCENTRIC), MASS, given)

    assert both(answer("ambiguous", MASS, sets=[[MASS, ECCENTRIC]]))
    assert not both(answer("ambiguous", SCALE, sets=[[SCALE, ECCENTRIC]]))
    assert not both(answer("explained", ECCENTRIC, MASS))
    assert not both(None)


def test_every_claim_counts_as_a_false_alarm_and_only_a_sure_name_as_overclaimed():
    for verdict in ("explained", "ambiguous", "unknown_effect"):
        assert score.claimed(answer(verdict))
    assert not score.claimed(NOTHING)
    assert score.sure(answer("explained", SCALE, probability=0.91))
    assert not score.sure(answer("ambiguous", SCALE, probability=0.9))
    assert not score.sure(answer("unknown_effect"))


@pytest.mark.parametrize(
    ("true", "driver", "right", "wrong"),
    [
        (("cable_drag", "joint4"), "q2", ["joint4", "link4", "joint2", "link2"], ["joint3"]),
        (("softening", "joint3"), "torque3 x time", ["joint3"], ["joint2", "base"]),
        (("floor_wave", "base"), "time", ["base", "tracker"], ["joint1", "link1"]),
        (("yielding_plate", "tool"), "load", ["tool", "link6", "joint6"], ["marker:M1"]),
        (("oblique_reflector", "marker:M1"), "view", ["marker:M1"], ["marker:M2", "joint1"]),
        (("wrist_coupling", "wrist"), "", ["wrist", "joint4", "joint6"], ["joint3"]),
        (("thermal_expansion", "all"), "", ["all", "link2"], ["base"]),
    ],
)
def test_location(true, driver, right, wrong):
    sealed = truth(true, location={"stage": "", "where": true[1], "driver": driver})
    for where in right:
        assert score.location_right(sealed, answer("unknown_effect", where=where)), where
    for where in wrong:
        assert not score.location_right(sealed, answer("unknown_effect", where=where)), where
    assert not score.location_right(sealed, answer("unknown_effect"))


def test_calibration_error_is_that_of_the_definition():
    """Ten answers at 0.95 of which eight are right, ten at 0.55 of which five are."""
    given = [(ECCENTRIC, 0.95, 8), (MASS, 0.95, 2), (ECCENTRIC, 0.55, 5), (MASS, 0.55, 5)]
    found = [
        {"truth": truth(ECCENTRIC), "answer": answer("explained", name, probability=p)}
        for name, p, n in given
        for _ in range(n)
    ]
    assert calibration_error(reliability(found)) == pytest.approx((0.15 + 0.05) / 2)


def test_wilson_interval():
    """8 of 10: 0.490 to 0.943 (Brown, Cai and DasGupta 2001 and any table); ends stay in [0, 1]."""
    assert bars.wilson(8, 10) == "0.490 to 0.943"
    assert bars.wilson(0, 10).startswith("0.000") and bars.wilson(10, 10).endswith("1.000")


# --- nothing leaks, nothing is lost -----------------------------------------------------------


class Blindfold(worker.Worker):
    """Answers without the tool, and looks around in what it was given."""

    def __init__(self):
        super().__init__()
        self.observed, self.tables = [], []

    def diagnose(self, folder, *arguments):
        self.observed.append((folder, arguments, sorted(p.name for p in folder.iterdir())))
        self.tables.append((folder / "data.csv").read_text().splitlines())
        given = dict.fromkeys(records.KEPT) | NOTHING | {"candidates": [{}] * 99}
        (folder / one_world.ANSWER).write_text(json.dumps(given))
        return worker.Run(0, 1.0, "")


def task(**changes):
    recipe = Recipe("encoder_scale-8-000", (5, 1), ("encoder_scale",), poses=8)
    return replace(suites.Task("left_out", recipe, without=("encoder_scale",)), **changes)


def test_the_tool_sees_neither_the_truth_nor_a_name_that_betrays_it(monkeypatch):
    folders = []
    make = one_world.tempfile.mkdtemp
    monkeypatch.setattr(
        one_world.tempfile,
        "mkdtemp",
        lambda **k: folders.append(Path(make(**k))) or str(folders[-1]),
    )
    blind = Blindfold()
    record = one_world.diagnose_world(task(), blind, {"seed": 5})
    ((visible, arguments, files),) = blind.observed
    sealed = next(f for f in folders if f != visible)
    assert files == ["arm.urdf", "cell.toml", "data.csv"]
    assert arguments == (
        "-o",
        one_world.ANSWER,
        "--cell-out",
        one_world.CELL,
        "--without",
        "encoder_scale",
    )
    assert not visible.is_relative_to(sealed) and not sealed.is_relative_to(visible)
    assert "encoder" not in str(visible) and visible.name[:6] != sealed.name[:6]
    assert record["truth"]["effects"][0]["effect"] == "encoder_scale"
    assert len(record["answer"]["candidates"]) == records.CANDIDATES
    assert not visible.exists() and not sealed.exists()


def test_neither_files_nor_names_of_the_visible_folder_hold_the_truth(tmp_path):
    world = task().recipe.draw()
    write_world(world, tmp_path / "v", tmp_path / "s")
    text = "".join(p.read_text() for p in (tmp_path / "v").iterdir())
    sealed = json.loads((tmp_path / "s" / "truth.json").read_text())
    for secret in ("encoder_scale", *(f"{v}" for v in sealed["effects"][0]["values"].values())):
        assert secret not in text


def test_the_worker_is_given_no_environment_and_cannot_import_the_study(tmp_path, monkeypatch):
    """It runs a stand-in for the script that tells what a process of its kind can reach."""
    probe = tmp_path / "probe.py"
    probe.write_text(
        "import importlib.util, json, os, sys\n"
        "for line in sys.stdin:\n"
        "    told = [sorted(os.environ), importlib.util.find_spec('draw') is None, os.getcwd()]\n"
        "    done = {'exit': 0, 'seconds': 0.0, 'message': json.dumps(told)}\n"
        "    print(json.dumps(done), flush=True)\n"
    )
    monkeypatch.setattr(worker, "SCRIPT", probe)
    monkeypatch.setenv("SEED_OF_THE_STUDY", "5")
    monkeypatch.setenv("PYTHONPATH", str(FOLDER))
    asked = worker.Worker()
    environment, cannot_import, cwd = json.loads(asked.diagnose(tmp_path).message)
    asked.close()
    assert set(environment) <= {*worker.KEPT, "OPENBLAS_NUM_THREADS", "LC_CTYPE"}
    assert cannot_import and Path(cwd) != FOLDER


@pytest.mark.parametrize(("body", "why"), [("sys.exit(3)", "crashed"), ("time.sleep(60)", "time")])
def test_a_worker_that_dies_or_hangs_is_a_failed_world_and_the_next_one_is_served(
    tmp_path, monkeypatch, body, why
):
    script = tmp_path / "script.py"
    script.write_text(
        "import json, sys, time\n"
        "for line in sys.stdin:\n"
        "    if 'bad' in line:\n"
        f"        {body}\n"
        "    print(json.dumps({'exit': 0, 'seconds': 0.0, 'message': ''}), flush=True)\n"
    )
    monkeypatch.setattr(worker, "SCRIPT", script)
    asked = worker.Worker(timeout=2.0)
    failed = asked.diagnose(tmp_path / "bad")
    assert failed.exit == -1 and why in failed.message
    assert asked.diagnose(tmp_path / "good").exit == 0
    asked.close()


def test_the_script_runs_the_command_in_the_folder_and_passes_on_exit_code_and_message(tmp_path):
    """A table of too few poses: exit 1, and the tool's own words."""
    world = draw_world((5, 2), "few", [], poses=3, arm="medium")
    write_world(world, tmp_path / "v", tmp_path / "s")
    asked = worker.Worker()
    done = asked.diagnose(tmp_path / "v", "-o", "diagnosis.json")
    asked.close()
    assert done.exit == 1 and "data.csv" in done.message and "Traceback" not in done.message
    assert not (tmp_path / "v" / "diagnosis.json").exists()


# --- the study ---------------------------------------------------------------------------------


OPTIONS = dict.fromkeys({name.partition("-")[0] for name in suites.SUITES}, 1)


def test_a_task_is_the_suites_world_of_that_name_under_the_studys_seed(monkeypatch):
    """However many worlds the study has: a part of it draws the same ones.  The first and the last
    of every suite."""
    drawn = []

    def one(task, origin):
        drawn.append(task)
        return origin | {"suite": task.suite, "answer": None, "seconds": 1.0}

    monkeypatch.setattr(study, "in_own_worker", one)
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


def test_what_the_study_returns_is_what_study_toml_lists(monkeypatch):
    monkeypatch.setattr(one_world, "_own_worker", Blindfold)
    monkeypatch.setattr(study, "named", lambda *_: task())
    prepared = read_study(FOLDER, seed=5)
    row = study.run(prepared.tasks[0].values, prepared.tasks[0].rng())
    assert set(row) == set(prepared.sources.columns)
    assert row["verdict"] == NOTHING["verdict"] and row["seconds"] == 1.0
    assert json.loads(row["record"])["truth"]["effects"][0]["effect"] == "encoder_scale"


# --- suites -----------------------------------------------------------------------------------


def test_suites_are_reproducible_and_share_no_world():
    first = {s: next(suites.tasks(s, 3, 1)).recipe.draw() for s in suites.SUITES}
    again = next(suites.tasks("catalogue", 3, 1)).recipe.draw()
    assert np.array_equal(again.visits.q, first["catalogue"].visits.q)
    assert len({w.specimen.true.offset.tobytes() for w in first.values()}) == len(first)


def test_names_are_unique_in_a_suite_and_each_effect_is_left_out_of_its_own_world():
    for name in suites.SUITES:
        every = [t.recipe.name for t in suites.tasks(name, 3, 6)]
        assert len(set(every)) == len(every)
    for t in suites.tasks("left_out", 3, 2):
        assert t.without == t.recipe.effects


# --- what only the truth can say --------------------------------------------------------------


@pytest.fixture(scope="module")
def eccentric(tmp_path_factory):
    """A world with a strong eccentricity at joint 4, and its plain fit."""
    where = tmp_path_factory.mktemp("world")
    world = draw_world(
        (5, 3), "e", ["gear_eccentricity:joint4"], factor=2.0, poses=30, arm="medium", level=20e-6
    )
    write_world(world, where / "v", where / "s")
    return world, where, afterwards.plain_fit(where / "v")


def test_distance_scales_with_the_effect_and_does_not_see_the_noise_that_was_drawn(eccentric):
    world, _, base = eccentric
    (effect,) = world.effects
    (one,) = afterwards.distances(base, world)
    half = replace(effect, values={k: v / 2 for k, v in effect.values.items()})
    (other,) = afterwards.distances(base, replace(world, effects=(half,)))
    assert one["distance"] <= one["nothing"]
    assert other["nothing"] == pytest.approx(one["nothing"] / 2, rel=0.01)


def test_what_the_tool_went_without_is_no_rival(eccentric):
    world, _, base = eccentric
    (one,) = afterwards.distances(base, world)
    nearest = one["rival"].partition(":")[0]
    (other,) = afterwards.distances(base, world, (nearest,))
    assert not other["rival"].startswith(nearest)
    assert other["distance"] > one["distance"] and other["nothing"] == one["nothing"]


def test_an_effect_beside_another_is_never_farther_from_nothing_than_alone(eccentric):
    """Its column may be explained by the other's in part."""
    world, _, base = eccentric
    (effect,) = world.effects
    second = replace(
        effect, name="gear_second_harmonic", values={"harmonic2_sin": 1e-4, "harmonic2_cos": 5e-5}
    )
    both = afterwards.distances(base, replace(world, effects=(effect, second)))
    (alone,) = afterwards.distances(base, world)
    assert both[0]["nothing"] < alone["nothing"] * (1 + 1e-6)


def test_true_reduction_is_nearly_whole_for_the_true_effect_and_none_for_an_idle_one(
    eccentric, tmp_path
):
    world, where, base = eccentric
    text = (where / "v" / "cell.toml").read_text()

    def reduction(effect, values):
        cell = where / "v" / "extended.toml"
        cell.write_text(text.replace('"marker_position"]', f'"marker_position", "{effect}"]'))
        found = {"effects": [{"parameters": [{"name": k, "value": v} for k, v in values.items()]}]}
        return afterwards.true_reduction(base, found, cell, where / "s" / "fresh.csv")

    true = {f"joint4.{k}": v for k, v in world.effects[0].values.items()}
    assert reduction("gear_eccentricity:joint4", true) > 0.7
    assert abs(reduction("encoder_scale:joint1", {"joint1.encoder_scale": 0.0})) < 0.1


def test_extra_visits_join_as_poses_of_their_own_after_the_campaign(tmp_path):
    world = task().recipe.draw()
    extra = extra_poses.random_visits(world, 3, np.random.default_rng(0))
    both = extra_poses.joined(world.visits, extra)
    assert len(np.unique(both.pose)) == 8 + 3
    assert np.all(np.diff(both.time) > 0) and len(both.q) == 2 * (8 + 3)


@pytest.fixture
def planned(tmp_path):
    """A world's visible folder with a plan of two poses in it, and the poses."""
    world = task().recipe.draw()
    write_world(world, tmp_path / "v", tmp_path / "s")
    q = draw_poses(world.spec, 2, np.random.default_rng(1))
    header = [f"q{j + 1}_rad" for j in range(6)]
    lines = [",".join(["configuration", *header, "force_x_N", "force_y_N", "force_z_N", "time_s"])]
    lines += [
        ",".join([str(k), *(f"{v:.9f}" for v in q[k]), "0", "0", str(f), str(9000 + 60 * k)])
        for k in range(2)
        for f in (0, -100)
    ]
    (tmp_path / "v" / "extra.csv").write_text("\n".join(lines) + "\n")
    return world, tmp_path / "v", q


def test_a_plan_is_read_as_the_visits_it_asks_for(planned):
    world, visible, q = planned
    visits = extra_poses.read_visits(world, visible / "extra.csv")
    assert np.allclose(visits.q, np.repeat(q, 2, axis=0), atol=1e-9)
    assert visits.force[:, 2].tolist() == [0, -100, 0, -100]
    assert visits.time.tolist() == [9000, 9000, 9060, 9060]
    assert visits.pose.tolist() == [0, 0, 1, 1]


def test_planned_poses_are_measured_and_diagnosed_beside_as_many_and_twice_as_many_random_ones(
    planned,
):
    world, visible, _ = planned
    blind = Blindfold()
    done = extra_poses.with_extra_poses(world, visible, "extra.csv", blind)
    own = (visible / "data.csv").read_text().splitlines()
    assert done["n_poses"] == 2 and len(blind.tables) == 3
    for table, poses in zip(blind.tables, (2, 2, 4), strict=True):
        assert table[: len(own)] == own
        assert len(table) - len(own) == poses * 2 * len(world.spec.markers)
    assert extra_poses.with_extra_poses(world, visible, "none.csv", blind) is None


# --- tables -----------------------------------------------------------------------------------


def test_the_report_counts_every_world_and_says_which_bars_are_met():
    def record(suite, k, given, **more):
        sealed = truth(ECCENTRIC) | {"plan": {"poses": 60}}
        return {
            "suite": suite, "world": f"{suite}-{k}", "seed": 5, "factor": None,
            "seconds": 4.0, "truth": sealed, "answer": given,
        } | more  # fmt: skip

    right, wrong, done = answer("explained", ECCENTRIC), answer("explained", SCALE), []
    for k in range(20):
        at = [{"distance": 7.0 if k else 1.5, "nothing": 7.5}]
        given = right if k else wrong
        done.append(record("catalogue", k, given, distances=at))
    for k in range(10):
        done.append(record("clean-outliers", k, NOTHING if k else right))
    lines = {"record": [json.dumps(r) for r in done], "elastocal": ["0.1+gabc"] * len(done)}
    text = study.summary(pd.DataFrame(lines))
    cells = [line.strip("| ").split(" | ") for line in text.splitlines()]
    bar = {(row[0], row[1]): row[3:] for row in cells if len(row) == 6}
    alone = "one effect, 60 poses"
    assert "seed 5" in text and "30 worlds" in text and "0.1+gabc" in text
    assert bar[alone, "right"] == ["0.950 (0.764 to 0.991)", "20", "yes"]
    assert bar[alone, "wrong name"] == ["0.050 (0.009 to 0.236)", "20", "NO"]
    assert bar["… with d ≥ 5", "named outright"][1:] == ["19", "yes"]
    assert bar["no effect, outliers", "an effect claimed"][1:] == ["10", "NO"]
    assert "1 × encoder_scale:joint3" in text


def test_the_reliability_curve_is_drawn(tmp_path):
    draw_reliability([(0.8, 0.75, 20), (0.98, 1.0, 50)], tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 0


def test_alike_pairs_are_named_as_the_tool_names_them():
    for effect, rival in ALIKE.items():
        sealed = truth(tuple(effect.split(":")))
        assert bars._rival({"truth": sealed}) == tuple(rival.split(":"))


@pytest.mark.parametrize(("d", "parameters"), [(0.0, 1), (3.0, 1), (4.0, 3)])
def test_the_power_of_a_test_is_how_often_it_rejects(d, parameters):
    """By drawing the χ² of a mean at distance d from zero, at a level that draws can show."""
    rng = np.random.default_rng(4)
    z = rng.normal(size=(200_000, parameters))
    least = np.quantile((z**2).sum(axis=1), 1 - LEVEL / CANDIDATES)
    z[:, 0] += d
    assert ((z**2).sum(axis=1) > least).mean() == pytest.approx(power(d, parameters), abs=0.02)
