"""The page of file formats names every key that is read and every key that is written."""

import json
import re
from dataclasses import fields
from pathlib import Path

import cell_keys_page
import pytest
from support.design_commands import elastocal

from elastocal.config import keys_of, tables_in
from elastocal.diagnosis.diagnosis import Curve, RivalPair, Untested
from elastocal.identification.faulty_readings import FaultyGroup
from elastocal.identification.knowledge import Knowledge
from elastocal.identification.outliers import Outlier
from elastocal.measurements import families
from elastocal.model.dh import DH_FAMILIES

ROOT = Path(__file__).parents[2]
CAMPAIGN = ROOT / "tests" / "golden" / "inputs" / "campaign"
IMPORT = f"import {CAMPAIGN}/points.txt {CAMPAIGN}/poses.dat --preset spatialanalyzer --preset kuka"
PAGE = (ROOT / "docs" / "file-formats.md").read_text(encoding="utf-8")
# Their keys are names of parameters, places, drivers or settings of the arm at hand.
NAMED_BY_THE_ARM = (
    "terms", "held", "prior_share", "drivers", "stages", "places", "settings", "removed_by",
)  # fmt: skip


def section(heading):
    return PAGE.split(f"\n## {heading}", 1)[1].split("\n## ", 1)[0]


def keys(value):
    if isinstance(value, dict):
        for key, inside in value.items():
            yield re.sub(r"^q[2-9]_", "q1_", key)  # "q1_deg …" on the page
            if key not in NAMED_BY_THE_ARM:
                yield from keys(inside)
    elif isinstance(value, list | tuple):
        for inside in value:
            yield from keys(inside)


def missing(wanted, text):
    """Keys that do not stand, as a whole word, inside `code` of a text."""
    code = " ".join(re.findall(r"`([^`]+)`", text))
    return sorted(k for k in set(wanted) if not re.search(rf"(?<!\w){re.escape(k)}(?!\w)", code))


KNOWLEDGE_TABLES = [t for known in keys_of(Knowledge) for t, _ in tables_in(known.kind)]


@pytest.mark.parametrize("title, table", cell_keys_page.tables())
def test_every_key_of_the_cell_file_is_on_the_page(title, table):
    toml = PAGE.split("\n## Measurement table", 1)[0]
    keys = [known.name for known in keys_of(table)]
    absent = [k for k in keys if not re.search(rf"(?<!\w){k}(?!\w)", toml)]
    assert not absent, f"{title}: {absent}"


@pytest.mark.parametrize("table", [Knowledge, *KNOWLEDGE_TABLES])
def test_every_key_of_the_knowledge_file_is_on_the_page(table):
    assert len(KNOWLEDGE_TABLES) == 4
    assert not [k.name for k in keys_of(table) if k.name not in section("Knowledge file")]


def test_every_column_of_the_measurement_table_is_on_the_page():
    text = section("Measurement table")
    for family in families(("revolute",) * 6).values():
        for stem in family.units:
            of_a_joint = re.fullmatch(
                r"(q|torque_|approach_|before_)[2-6]", stem
            )  # "…" on the page
            assert of_a_joint or re.search(rf"(?<!\w){stem}", text), stem


def test_every_column_of_the_dh_table_is_on_the_page():
    text = PAGE.split("### DH table", 1)[1].split("\n## ", 1)[0]
    for family in DH_FAMILIES:
        for stem in family.units:
            assert any(way in text for way in family.columns(stem)), stem


def test_every_key_of_an_identification_is_on_the_page(course):
    text = section("Result of `identify`")
    rare = [f.name for kind in (Outlier, FaultyGroup) for f in fields(kind)]
    for result in course.results:
        assert not missing([*keys(result), *rare], text)


def test_every_key_of_a_diagnosis_is_on_the_page():
    golden = ROOT / "tests" / "golden" / "expected" / "diagnose_one.json"
    published = json.loads(golden.read_text(encoding="utf-8"))[-1]["files"]["diagnosis.json"]
    shortened = {"entries", "some", "keys"}  # words of the golden, where a list is long
    rare = [f.name for kind in (Curve, Untested, RivalPair) for f in fields(kind)]
    assert not missing([*{*keys(published)} - shortened, *rare], section("Diagnosis of `diagnose`"))
    assert published["effects"], "the example's backlash is found, so that its keys are compared"


@pytest.mark.parametrize(
    "command, heading",
    [
        ("", "Plan of `design`: `plan.json`"),
        ("compensate cell.toml result.json targets.csv", "Targets and commands of `compensate`"),
        ("export cell.toml result.json -o arm.urdf --load 0 0 -98", "Answer of `export`"),
        ("effects cell.toml", "Effects of `effects`"),
        (IMPORT, "Answer of `import`"),
    ],
)
def test_every_key_of_plans_and_of_what_is_done_with_a_result_is_on_the_page(
    course, monkeypatch, command, heading
):
    monkeypatch.chdir(course.folder)
    answer = Path("extra.json").read_text(encoding="utf-8")
    if command:
        done = elastocal(*command.split(), "--json")
        assert done.exit_code == 0, done.output
        answer = done.stdout
    assert not missing(keys(json.loads(answer)), section(heading))
