"""`elastocal diagnose` around its engine: what it reads, writes, says and refuses."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from support.diagnoses import AMBIGUOUS, EXPLAINED, EXTRA, INSEPARABLE, TWO, VERDICTS, visits
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cell.work_cell import read_cell
from elastocal.cli.main import app
from elastocal.errors import InsufficientDataError
from elastocal.measurements import read_plan
from elastocal.saving import save_extra_poses

KINDS = ("revolute",) * 6


class Engine:
    """Stands in for the engine and for the design of extra poses; notes what they were given."""

    def __init__(self) -> None:
        self.answer, self.extra = EXPLAINED, EXTRA
        self.asked: list[object] = []
        self.planned: list[dict] = []

    def diagnose(self, model, table, options, progress):
        progress("diagnosing")
        self.asked.append(options)
        if isinstance(self.answer, Exception):
            raise self.answer
        return replace(self.answer, model=model, data=table.source)

    def plan_extra(self, model, table, diagnosis, progress, **asked):
        self.planned.append(asked)
        return self.extra


@pytest.fixture
def engine(monkeypatch):
    stand_in = Engine()
    for room, name in (("diagnose", "diagnose"), ("extra_poses", "plan_extra")):
        module = import_module(f"elastocal.diagnosis.{room}")
        monkeypatch.setattr(module, name, getattr(stand_in, name))
    return stand_in


@pytest.fixture
def campaign(tmp_path, engine):
    return write_campaign(tmp_path)


def run(campaign, *options):
    arguments = ["diagnose", *campaign, "-q", *options]
    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


def refused(campaign, engine, code, *fragments, options=(), asked=False):
    """Must end with `code` and a message with the fragments, nothing written, stdout empty."""
    folder = campaign[0].parent
    before = {path: path.read_bytes() for path in folder.iterdir()}
    result = run(campaign, *options)
    assert result.exit_code == code, result.stderr
    assert result.stdout == "" and "Traceback" not in result.stderr
    for fragment in fragments:
        assert re.search(fragment, result.stderr), f"{fragment!r} not in {result.stderr!r}"
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert bool(engine.asked) == asked


@pytest.mark.parametrize("name", VERDICTS)
def test_every_verdict_is_an_answer(name, campaign, engine):
    engine.answer = VERDICTS[name]
    written = campaign[0].parent / "diagnosis.json"
    told = run(campaign, "-o", written)
    assert told.exit_code == 0, told.stderr
    assert "Verdict:" in told.stdout and f"wrote {written}" in told.stdout.replace("\n", "")
    printed = run(campaign, "--json")
    assert json.loads(printed.stdout) == json.loads(written.read_text(encoding="utf-8"))
    assert json.loads(printed.stdout)["verdict"] == VERDICTS[name].verdict


def test_options_reach_the_engine(campaign, engine):
    assert run(campaign, "--seed", 5, "--without", "backlash", "--without", "gear_ripple")
    (options,) = engine.asked
    assert (options.seed, options.without) == (5, ("backlash", "gear_ripple"))


def test_report_names_the_command_and_hashes_its_inputs(campaign):
    page = campaign[0].parent / "r.html"
    assert run(campaign, "--report", page).exit_code == 0
    text = page.read_text(encoding="utf-8")
    assert "SHA-256" in text and "data.csv" in text and "cell.toml" in text


# --- the cell with the effects added --------------------------------------------------------


def test_identify_takes_the_cell_that_diagnose_writes(campaign, engine):
    cell, data = campaign
    (cell.parent / "next").mkdir()
    new = cell.parent / "next" / "cell.toml"
    told = run(campaign, "--cell-out", new)
    assert "gear_eccentricity:joint2" in told.stdout
    assert f"to go on: elastocal identify {new} {data} -o result.json" in told.stdout
    result = CliRunner().invoke(app, ["identify", str(new), str(data), "--json", "-q"])
    assert result.exit_code == 0, result.stderr
    names = {p["name"] for p in json.loads(result.stdout)["parameters"]}
    assert {"joint2.eccentricity_sin", "joint2.eccentricity_cos", "joint2.offset"} <= names


def test_searched_constants_are_in_the_cell(campaign, engine):
    engine.answer = TWO
    new = campaign[0].parent / "new.toml"
    run(campaign, "--cell-out", new)
    assert read_cell(new).model.nominal.settings == {"joint1": {"jump_time_s": 4325.5}}


def test_without_a_finding_the_model_stays_as_it_is(campaign, engine):
    engine.answer = VERDICTS["nothing"]
    new = campaign[0].parent / "new.toml"
    told = run(campaign, "--cell-out", new)
    assert "with no further effect" in told.stdout and "to go on" not in told.stdout
    assert read_cell(new).model == read_cell(campaign[0]).model


# --- extra poses ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ambiguous", "unknown"])
def test_extra_poses_are_designed_for_open_verdicts(name, campaign, engine):
    engine.answer = replace(VERDICTS[name], extra=None)
    plan = campaign[0].parent / "extra.csv"
    told = run(campaign, "--plan", plan, "--poses", 4, "--seed", 9)
    assert engine.planned == [{"most": 4, "seed": 9}]
    assert "2 poses, 3 visits" in told.stdout
    back = read_plan(plan, joint_kinds=KINDS)
    assert back.q == pytest.approx(EXTRA.plan.q, abs=1e-10)
    assert np.array_equal(back.force, EXTRA.plan.force)
    assert np.array_equal(back.approach, EXTRA.plan.approach)
    assert np.array_equal(back.time, EXTRA.plan.time)
    assert "rises" in told.stdout


@pytest.mark.parametrize("name", ["explained", "nothing"])
def test_where_there_are_no_rivals_no_poses_are_designed(name, campaign, engine):
    engine.answer = VERDICTS[name]
    plan = campaign[0].parent / "extra.csv"
    told = run(campaign, "--plan", plan)
    assert told.exit_code == 0 and not engine.planned
    assert "no rivals" in told.stdout and not plan.exists()


def test_where_no_pose_helps_it_is_said(campaign, engine):
    engine.answer, engine.extra = AMBIGUOUS, INSEPARABLE
    plan = campaign[0].parent / "extra.csv"
    told = run(campaign, "--plan", plan)
    assert told.exit_code == 0 and not plan.exists()
    assert "no pose tells the rivals apart" in told.stdout
    assert "No pose that this cell allows" in told.stdout


def test_a_pose_visited_again_under_the_same_force_has_its_own_name(tmp_path):
    twice = visits(approach=False, time=False).take(np.array([0, 1, 0, 0]))
    save_extra_poses(tmp_path / "extra.csv", twice, KINDS)
    back = read_plan(tmp_path / "extra.csv", joint_kinds=KINDS)
    names = [back.configuration_labels[k] for k in back.configuration]
    assert names == ["X1", "X1", "X1/2", "X1/3"]
    assert back.time is None and back.approach is None


# --- wrong input: one message, the right code, nothing written, no time lost ----------------


def test_data_that_support_no_answer(campaign, engine):
    engine.answer = InsufficientDataError("data.csv: 2 configurations; measure at least 9")
    outputs = ("-o", "d.json", "--report", "r.html", "--plan", "e.csv", "--cell-out", "c.toml")
    folder = campaign[0].parent
    options = [folder / o if not o.startswith("-") else o for o in outputs]
    refused(campaign, engine, 1, "measure at least 9", options=options, asked=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_output_folder_that_cannot_be_written(campaign, engine):
    folder = campaign[0].parent / "locked"
    folder.mkdir(mode=0o500)
    result = run(campaign, "-o", folder / "d.json")
    assert result.exit_code == 2 and "permission" in result.stderr and not engine.asked
