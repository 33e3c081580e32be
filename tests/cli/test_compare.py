"""elastocal compare: an arm before and after a collision, and one that nothing happened to."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.design_commands import elastocal

import elastocal as ec
from elastocal.identification.knowledge import Constraints, LinearEquality

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial"
CELL = """\
robot.dh = "arm.csv"
tool.load_point_m = [0.25, 0.0, 0.10]
tool.markers_m = {M1 = [0.25, 0.0, 0.05], M2 = [-0.10, 0.20, 0.05], M3 = [-0.10, -0.20, 0.10]}
tracker.sigma_um = 10
model.effects = ["base_frame", "joint_offset", "link_geometry", "marker_position"]
"""
BENT, BY = "link2.dx", 0.3e-3  # m: what the collision did


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """old.json; bent.json after a collision; same.json without; each with its own set-up."""
    made = tmp_path_factory.mktemp("compare")
    shutil.copyfile(TUTORIAL / "arm.csv", made / "arm.csv")
    (made / "cell.toml").write_text(CELL)
    model = ec.Model(made / "cell.toml")
    rng = np.random.default_rng(5)
    truth = {p.name: p.nominal + p.typical * rng.normal() for p in model.parameters}
    for name, change in (("old", 0.0), ("bent", BY), ("same", 0.0)):
        values = truth | {BENT: truth[BENT] + change}
        values |= {f"base.{k}": 1.0 + 0.2 * rng.normal() for k in ("x", "y", "z", "rz")}
        values |= {n: v + 1e-3 * rng.normal() for n, v in values.items() if n.startswith("marker")}
        q = rng.uniform(-1.4, 1.0, (24, 6))
        data = ec.simulate(model, q, values=values, seed=int(rng.integers(1000)))
        ec.identify(model, data).save(made / f"{name}.json")
    return made


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)


def run(*words):
    done = elastocal("compare", *words)
    return done.exit_code, done.stdout, done.stderr


def test_after_a_collision_the_bent_link_is_named(folder, monkeypatch):
    code, out, err = run("cell.toml", "old.json", "bent.json", "-o", "c.json", "--report", "c.html")
    assert code == 0, err
    assert f"Verdict: The arm has changed: {BENT}." in (flat := " ".join(out.split()))
    assert "the probability that one is named is 0.05 at most" in flat
    found = json.loads(Path("c.json").read_text())
    assert (found["verdict"], found["changed"]) == ("changed", [BENT])
    (one,) = (p for p in found["parameters"] if p["changed"])
    assert abs(one["change"] - BY) < 4 * one["std"] and one["std"] < 1e-4
    assert 200 < found["tool"]["rms_um"] < 450 and found["tool"]["by_chance_rms_um"] < 60
    page = Path("c.html").read_text()
    assert "The arm has changed" in page and "Parameter by parameter" in page and "<svg" in page
    assert page.count("SHA-256") == 3
    monkeypatch.setenv("COLUMNS", "60")  # of which none is cut
    lines = run("cell.toml", "old.json", "bent.json")[1].splitlines()
    (row,) = (s for s in lines if BENT in s[:12])
    assert row.rstrip().endswith(" changed") and len(row.rstrip()) <= 60


def test_where_nothing_happened_nothing_is_named_though_base_and_markers_moved():
    code, out, err = run("old.json", "same.json", "--json")  # as it was called once
    assert code == 0 and "elastocal compare cell.toml old.json same.json" in err
    found = json.loads(out)
    assert found["verdict"] == "no_change_shown" and found["changed"] == []
    assert not any(p["name"].startswith(("base", "marker")) for p in found["parameters"])
    assert found["tool"]["rms_um"] < 2 * found["tool"]["by_chance_rms_um"]


def test_what_the_model_lacks_is_no_change(folder):
    """Told as equal noise, which it is not, it made two of these four pairs a change."""
    (folder / "bare.toml").write_text(CELL.replace("tracker.sigma_um = 10\n", ""))
    (folder / "geared.toml").write_text(CELL.replace("link_geometry", "gear_eccentricity"))
    bare, geared, rng = ec.Model("bare.toml"), ec.Model("geared.toml"), np.random.default_rng(3)
    gears = {n: 3e-4 * rng.normal() for n in geared.names if "eccentricity" in n}
    q = rng.uniform(-1.4, 1.0, (8, 60, 6))
    fits = [ec.identify(bare, ec.simulate(geared, q[k], values=gears, seed=k)) for k in range(8)]
    told = [ec.compare(*pair).verdict for pair in zip(fits[::2], fits[1::2], strict=True)]
    assert told.count("no_change_shown") >= 3, told


def test_what_another_choice_of_parameters_determined_is_told_in_that_of_the_old(folder):
    """The same arm identified with another complete set: nothing but the names differs."""
    model = ec.Model("cell.toml")
    data = ec.simulate(model, np.random.default_rng(1).uniform(-1.4, 1.0, (24, 6)), seed=3)
    free = ec.identify(model, data)
    chosen = next(n for n in free.determined if n.startswith("link") and free[n].combined_with)
    held = ec.identify(model, data, fixed=[chosen])
    found = ec.compare(free, held)
    assert found.first_order and not found.changed and found.distance.max() < 1e-6


def test_what_one_session_alone_shows_is_named_and_the_rest_compared(folder):
    (folder / "both.toml").write_text(CELL.replace('"link_geometry"', '"joint_compliance"'))
    model = ec.Model("both.toml")
    q = np.random.default_rng(3).uniform(-1.4, 1.0, (2, 20, 6))
    bent = {"joint2.offset": 1e-3, "joint2.compliance": 2e-6}
    loaded = ec.identify(model, ec.simulate(model, q[0], load=[0, 0, -300.0], values=bent, seed=1))
    for offset in (1e-3, 1.2e-3):
        bare = ec.simulate(model, q[1], values=bent | {"joint2.offset": offset}, seed=2)
        unloaded = ec.identify(model, bare)
        for pair in ((loaded, unloaded), (unloaded, loaded)):
            found = ec.compare(*pair)
            assert [c.name for c in found.changed] == ["joint2.offset"] * (offset > 1e-3)
            assert "joint2.compliance" in found.not_compared["one session alone shows it"]


def test_a_softer_joint_is_seen_under_the_loads_of_the_campaigns(folder):
    soft = CELL.replace('"joint_offset", "link_geometry"', '"joint_compliance"')
    (folder / "soft.toml").write_text(soft)
    model = ec.Model("soft.toml")
    rng, name = np.random.default_rng(2), "joint3.compliance"
    for k, value in enumerate((2e-6, 4e-6)):
        values = {p.name: 2e-6 for p in model.parameters if p.name.endswith("compliance")}
        q = rng.uniform(-1.4, 1.0, (10, 6))
        data = ec.simulate(model, q, load=[0, 0, -300.0], values=values | {name: value}, seed=k)
        ec.identify(model, data).save(f"soft{k}.json")
    code, out, err = run("soft.toml", "soft0.json", "soft1.json", "-o", "c.json")
    assert code == 0 and "under (0, 0, -300) N, those of the earlier" in " ".join(out.split()), err
    found = json.loads(Path("c.json").read_text())
    assert found["changed"] == [name]
    assert found["tool"]["forces_N"] == [[0, 0, -300]] == [found["tool"]["force_N"]]
    assert found["tool"]["rms_um"] > 10 * found["tool"]["by_chance_rms_um"] > 0
    arms = [ec.read_calibrated("soft.toml", f"soft{k}.json") for k in (0, 1)]
    assert ec.compare(*arms, load=[0, 0, 0]).distance.max() < 1e-6
    one = ec.simulate(model, q, load=[0, 0, -300.0], values={name: 4e-6}, seed=7)
    stiff = {c.name: c.change for c in ec.compare(arms[1], ec.identify(model, one)).changed}
    # Compared with limits of what now hardly shows.
    assert len(stiff) > 2 and stiff == pytest.approx(dict.fromkeys(stiff, -2e-6), rel=0.2)
    with pytest.raises(ec.InputError, match=f"{name} is held in table at .* deviations away"):
        ec.compare(arms[0], ec.identify(model, data, fixed=[name]))
    tied = LinearEquality({"joint4.compliance": 1.0, "joint5.compliance": -1.0})
    known = ec.Knowledge(constraints=Constraints(equalities=(tied,)))
    assert ec.compare(*(ec.identify(model, data, knowledge=known) for _ in "12")).p > 0.99
