"""Whole simulated arms: what is drawn, what an oracle can know of them, and how answers count."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "blind_diagnosis"
sys.path.insert(0, str(FOLDER))

import bars
import one_world
import records
import result_tables
import suites
import worker
from arm_data import ARMS
from whole_columns import components, moments, scene_of
from whole_draw import RANGES, draw_whole
from whole_laws import CREEP, LAST_MOVE, LINES, WEIGHTS, creep, gear_error
from whole_losses import losses, units
from whole_oracle import Gap, Sights, gap_of, geometry_error, oracle_error, oracle_errors
from whole_score import Name, score_parts
from whole_search import Search, true_orders
from world_files import write_world


@pytest.fixture(scope="module", params=ARMS)
def sights(request):
    return Sights.of(draw_whole((8, 1), "whole", 60, arm=request.param))


def rms(x):
    return float(np.sqrt(np.mean(x**2)))


def test_every_joint_has_everything(sights):
    world = sights.world
    joints = [f"joint{j + 1}" for j in range(world.spec.skeleton.n_joints)]
    for name in (LINES, LAST_MOVE):
        assert [e.where for e in world.effects if e.name == name] == joints
    assert {e.name for e in world.effects} == {LINES, LAST_MOVE, WEIGHTS, CREEP}
    assert (world.noise.repeatability >= RANGES.scatter[0]).all()
    gear = world.spec.gear
    for e in world.effects:
        if e.name == LINES:
            orders = [order for line, order in e.settings.items() if line != "eccentricity"]
            assert RANGES.order[0] <= orders[0] and max(orders) <= RANGES.highest_order
            assert orders == pytest.approx(orders[0] * np.arange(1, len(orders) + 1))
            turn = np.linspace(0.0, 2 * np.pi, 1000)
            peak = np.abs(gear_error(e, turn)).max()
            assert 30e-6 * gear < peak < 300e-6 * gear


def test_the_tool_is_told_neither_weights_nor_orders(tmp_path):
    world = draw_whole((8, 2), "whole", 8, approach=False)
    write_world(world, tmp_path / "v", tmp_path / "s")
    assert "mass" not in (tmp_path / "v" / "arm.urdf").read_text()
    cell = (tmp_path / "v" / "cell.toml").read_text()
    assert "link_gravity = false" in cell and "orders" not in cell
    header = (tmp_path / "v" / "data.csv").read_text().splitlines()[0]
    assert "time_min" in header and "approach" not in header
    assert np.all(np.diff(world.visits.time) > 0)
    came = np.sign(np.diff(world.visits.q, axis=0))
    moved = came.any(axis=1)
    assert np.array_equal(world.visits.approach[1:][moved], came[moved])


def test_the_arm_moves_as_the_columns_say(sights):
    """All effects together, by MuJoCo and to first order: within a hundredth."""
    world = sights.world
    whole, bare = (w.noise_free(world.visits) for w in (world, replace(world, effects=())))
    parts = components(world, world.visits, sights.at_here)
    moved = (whole - bare).reshape(len(whole), -1)
    assert rms(moved - sum(p.moved for p in parts)) < 0.01 * rms(moved)
    (heavy,) = (e for e in world.effects if e.name == WEIGHTS)
    load = sights.at_here.carried + sights.at_here.weighing @ moments(heavy)
    assert load == pytest.approx(sights.at_here.load, abs=2e-3 * np.abs(load).max())


def test_columns_of_geometry_are_the_arms_own_derivatives():
    """A base and a link moved by 1 µm, an offset by 1 µrad."""
    world = draw_whole((8, 3), "whole", 8)
    scene, true = scene_of(world, world.visits), world.specimen.true
    start = world.noise_free(world.visits)
    offset, position = true.offset.copy(), true.skeleton.position.copy()
    offset[1] += 1e-6
    position[3] += true.skeleton.rotation[3] @ [0.0, 1e-6, 0.0]
    changed = {
        "base": replace(true, base_position=true.base_position + 1e-6 * np.eye(3)[0]),
        "joint": replace(true, offset=offset),
        "links": replace(true, skeleton=replace(true.skeleton, position=position)),
    }
    for name, k in (("base", 0), ("joint", 1), ("links", 6 * 2 + 1)):
        other = replace(world, specimen=replace(world.specimen, true=changed[name]))
        moved = (other.noise_free(world.visits) - start).reshape(len(start), -1)
        assert moved == pytest.approx(1e-6 * getattr(scene, name)[:, :, k], abs=1e-8)


def test_the_oracle_knows_what_geometry_does_not(sights):
    oracle = oracle_error(sights)
    assert 1e-6 < oracle < 0.15 * geometry_error(sights)
    assert oracle < 2.5 * sights.world.noise.level


def test_the_oracle_errs_as_its_covariance_says():
    """Mean square of 12 arms, each with some hundred degrees of freedom of its own."""
    every = [oracle_errors(Sights.of(draw_whole((8, 7, k), "w", 40))) for k in range(12)]
    ratios = np.array([error / expected for error, expected in every])
    assert np.mean(ratios**2) == pytest.approx(1.0, abs=0.2)


def test_more_poses_tell_the_oracle_more():
    few, many = (oracle_error(Sights.of(draw_whole((8, 4), "w", n))) for n in (60, 200))
    assert many < 0.8 * few


def test_an_oracle_who_searches_for_the_orders_stands_between_knowing_and_leaving_them_out():
    search = Search(Sights.of(draw_whole((8, 6), "w", 60, arm="medium")))
    true = true_orders(search.sights)
    oracle, known, none = oracle_error(search.sights), search.error(true), search.error({})
    assert 0.9 * oracle < known < 1.2 * oracle < none
    for j in (0, 1):
        others = {i: p for i, p in true.items() if i != j}
        gains = search.gains(others, j, np.array([true[j], true[j] + 3.0]))
        assert gains[0] > 10.0 > gains[1]


def test_what_is_left_out_costs_what_it_would_have_brought():
    """With all that there is named, an oracle with sags of each joint's own is left; without the
    lines of joint 1, they are the worst loss."""
    sights = Sights.of(draw_whole((8, 9), "w", 60, arm="medium"))
    names = {"lines": "gear_spectrum", "eccentricity": "gear_eccentricity", "sag": "gravity_sag",
             "move": "move_lag", "creep": "base_drift"}  # fmt: skip
    every = [{"effect": names[kind], "where": where} for kind, where in units(sights)]
    all_named, nothing = losses(sights, {"effects": every})
    assert not nothing and all_named < 1.5 * oracle_error(sights)
    first = {"effect": "gear_spectrum", "where": "joint1"}
    error, left = losses(sights, {"effects": [e for e in every if e != first]})
    ((fall, unit),) = left
    assert unit == ("lines", "joint1") and error > all_named
    assert fall == pytest.approx(np.sqrt(error**2 - all_named**2))


def test_shares_of_the_gap_sum_to_one_and_its_strengths_nearly(sights):
    gap = gap_of(sights)
    assert gap.share(gap.parts) == pytest.approx(1.0)
    assert sum(gap.share([part]) for part in gap.parts) == pytest.approx(1.0)
    assert sum(gap.strength([part]) for part in gap.parts) == pytest.approx(1.0, abs=0.5)
    J = sights.world.spec.skeleton.n_joints
    assert len(gap.parts) == 3 * J + 1
    assert gap.strength([("gravity", "joint1")]) < 1e-3  # its axis is vertical


def test_the_creep_is_correlated_over_its_length_and_as_large_as_drawn():
    sizes, apart = [], []
    for k in range(60):
        (e,) = (e for e in draw_whole((8, 5, k), "w", 2).effects if e.name == CREEP)
        moved = creep(e, np.array([0.0, e.settings["length_s"]]))
        sizes.append(moved[:, 0] ** 2)
        apart.append(moved[0, 0] * moved[1, 0])
    assert RANGES.shift[0] < np.sqrt(np.mean(sizes)) < RANGES.shift[1]
    assert np.mean(apart) / np.mean(sizes) == pytest.approx(np.exp(-0.5), abs=0.25)


# --- scores -----------------------------------------------------------------------------------

PARTS = (("angle", "joint1"), ("angle", "joint2"), ("gravity", "joint2"), ("time", "base"))
GAP = Gap(PARTS, np.diag([0.3, 0.1, 0.6 - 1e-5, 1e-5]) * 1e-8, 1e-4)


def component(family, where, share, half=0.05, **more):
    return {
        "family": family, "where": where, "share": share, "probability": 0.9,
        "share_ci90": [share - half, share + half], "effect": None,
    } | more  # fmt: skip


def scored(*parts, effects=()):
    return score_parts(GAP, {"components": list(parts), "effects": list(effects)})


def test_a_share_holds_where_its_interval_holds_the_truth():
    found = scored(component("angle", "joint1", 0.33), component("angle", "joint2", 0.2))
    assert [s.held for s in found.shares] == [True, False]
    assert found.missed == ("gravity:joint2",)


def test_what_acts_by_load_is_one_kind_and_adds_up():
    parts = (component("torque", "joint2", 0.25), component("gravity", "link2", 0.3))
    (share,) = scored(*parts).shares
    assert share.stated == pytest.approx(0.55) and share.true == pytest.approx(0.6, abs=1e-4)
    assert share.high - share.stated == pytest.approx(0.05 * np.sqrt(2))


def test_one_finding_may_stand_for_all_joints():
    found = scored(component("angle", "", 0.4), component("gravity", "all", 0.6))
    assert all(s.held for s in found.shares) and not found.missed


def test_names_that_an_arm_does_not_have_are_wrong_and_curves_are_none():
    found = scored(
        component("angle", "joint1", 0.3, effect="gear_ripple"),
        component("angle", "joint2", 0.1, effect="joint_curve"),
        component("load", "joint2", 0.6, effect="gravity_compensator"),
        component("time", "base", 0.01),
        component("move", "joint1", 0.01),
        component("angle", "joint2", 0.1, probability=0.2),
        effects=[{"effect": "gear_ripple", "where": "joint1"},
                 {"effect": "payload_error", "where": "load"}],
    )  # fmt: skip
    assert [(n.name, n.right) for n in found.names] == [
        ("gear_ripple:joint1", True), ("gravity_compensator:joint2", False),
        ("time:base", False), ("move:joint1", False), ("payload_error:load", False),
    ]  # fmt: skip
    assert not Name("gravity:joint3", 0.0, True).right


def test_an_answer_without_components_has_no_shares():
    found = score_parts(GAP, {"effects": [{"effect": "gear_eccentricity", "where": "joint2"}]})
    assert not found.shares and [n.right for n in found.names] == [True]
    assert found.missed == ("angle:joint1", "angle:joint2", "gravity:joint2")


# --- the study --------------------------------------------------------------------------------


class Stand(worker.Worker):
    """Answers as the command would; the model it writes errs a tenth less than the cell's own."""

    def run(self, folder, *arguments):
        if arguments[0] == "diagnose":
            assert not (folder / "new.csv").exists()
            given = dict.fromkeys(records.KEPT) | {"candidates": [], "effects": []}
            given |= {"verdict": "unknown_effect", "indistinguishable": []}
            given["components"] = [component("gravity", "joint2", 0.7, 0.3)]
            (folder / one_world.ANSWER).write_text(json.dumps(given))
        else:
            error = 90.0 if one_world.CELL in arguments else 100.0
            (folder / "result.json").write_text(json.dumps({"test": {"rms_um": error}}))
        return worker.Run(0, 1.0, "")


def test_a_whole_arm_is_judged_and_its_rows_stand_in_the_tables():
    task = next(suites.tasks("whole", 3, 1))
    record = one_world.diagnose_world(task, Stand(), {"seed": 3})
    whole = json.loads(json.dumps(record))["whole"]
    assert whole["geometry_mm"] == pytest.approx(0.1) and whole["tool_mm"] == pytest.approx(0.09)
    assert whole["shares"][0]["kind"] == "load" and "load:joint2" in whole["names"][0]["name"]
    record["version"] = "0"
    rows = {
        r.measure: r
        for r in bars.bar_rows(result_tables.by_suite([record]))
        if r.worlds == "whole arms, 60 poses"
    }
    assert rows["no worse than geometry alone"].measured.startswith("1.000")
    text = result_tables.report([record])
    assert "Whole arms, 60 poses" in text and "| load | 1 |" in text
