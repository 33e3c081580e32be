"""`elastocal diagnose` around its engine: what it reads, writes, says and refuses."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from support.diagnoses import EXPLAINED, EXTRA, VERDICTS
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cell.work_cell import read_cell
from elastocal.cli.main import app
from elastocal.errors import InsufficientDataError
from elastocal.measurements import read_measurements

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
    back = read_measurements(plan, joint_kinds=KINDS, observe="plan")
    assert back.q == pytest.approx(EXTRA.plan.q, abs=1e-10)
    assert np.array_equal(back.force, EXTRA.plan.force)
    assert np.array_equal(back.approach, EXTRA.plan.approach)
    assert np.array_equal(back.time, EXTRA.plan.time)
    assert "rises" in told.stdout


# --- wrong input: one message, the right code, nothing written, no time lost ----------------


def test_data_that_support_no_answer(campaign, engine):
    engine.answer = InsufficientDataError("data.csv: 2 configurations; measure at least 9")
    outputs = ("-o", "d.json", "--report", "r.html", "--plan", "e.csv", "--cell-out", "c.toml")
    folder = campaign[0].parent
    options = [folder / o if not o.startswith("-") else o for o in outputs]
    refused(campaign, engine, 1, "measure at least 9", options=options, asked=True)
