"""The diagnosis report: complete, self-contained, harmless."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED, EXTRA, HOSTILE, TWO, VERDICTS
from support.pages import Page

from elastocal.cell.arm_description import EffectChoice
from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.diagnosis import FaultyReading
from elastocal.errors import InputError
from elastocal.identification.error_budget import BudgetStep
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.report.figures import effect_shapes
from elastocal.report.page import page_of, write_page
from elastocal.simulation.simulate import simulate


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))


@pytest.fixture(scope="module")
def pages(model: Model) -> dict[str, str]:
    told = {"command": f"elastocal diagnose {HOSTILE}", "inputs": {HOSTILE: "0" * 64}, "seed": 7}
    return {
        name: page_of(replace(d, model=model, data=HOSTILE), **told) for name, d in VERDICTS.items()
    }


@pytest.mark.parametrize("name", VERDICTS)
def test_names_from_files_are_text_and_nothing_comes_from_elsewhere(name, pages):
    text = pages[name]
    page = Page(text)
    page.check_harmless(text)
    assert "<script>alert(1)</script>" in page.text


@pytest.mark.parametrize("name", VERDICTS)
def test_figures_are_well_formed_and_follow_the_page_colours(name, pages):
    figures = re.findall(r"<svg.*?</svg>", pages[name], re.DOTALL)
    shown = VERDICTS[name]
    assert len(figures) == 3 + bool(shown.curves) + bool(shown.components)
    for figure in figures:
        ElementTree.fromstring(figure)
        assert "aria-label" in figure
        assert "#0102" not in figure
    ids = re.findall(r'\bid="([^"]*)"', pages[name])
    assert len(ids) == len(set(ids))


def test_sections_appear_where_there_is_something_to_tell(pages):
    many = {name for name in VERDICTS if name.startswith("many")}
    heads = {
        "Shape of the unknown dependence": {"unknown"},
        "What the gap is made of": many,
        "Error curves of the joints": many,
        "Corrections without a name": {"many unknown"},
        "one at a time": many,
        "Effects found": {"explained", "two", "ambiguous", "planned", "inseparable"} | many,
        "These data cannot tell apart": {"ambiguous", "planned", "inseparable", "many ambiguous"},
        "Extra poses": {"planned", "inseparable"},
        "d with the extra poses": {"planned", "inseparable"},
        "The data single out no link": {"nothing", "unlocated"},
        "Readings left out as faulty": set(VERDICTS),
        "What could not be tested": set(VERDICTS),
    }
    for head, names in heads.items():
        assert {name for name, text in pages.items() if head in Page(text).text} == names, head


def test_every_number_of_the_answer_is_on_the_page(pages):
    page = Page(pages["explained"])
    rows = {row[0]: row for row in page.rows if row}
    assert rows["gear eccentricity at joint 2"][1] == "0.98"  # the last table of the two
    assert rows["joint2.eccentricity_sin"][1:] == ["0.112", "0.012", "mrad"]
    assert rows["joint 2 angle"][1:] == ["0.00050", "0.0040"]
    assert rows["joint 2"][1] == "0.98"
    assert rows["88"][1:] == ["29", "M3", "1.30 mm", "71.0"]
    assert rows["joint compliance"][1:3] == ["84.0 µm", "71.0 µm to 97.0 µm"]
    for candidate in EXPLAINED.candidates[1:6]:
        name = f"{candidate.effect.replace('_', ' ')}"
        assert any(key.startswith(name) for key in rows), name
    assert "elastocal diagnose" in page.text


def test_a_found_effect_stands_over_its_driver_with_what_was_read():
    """An eccentricity of joint 2 over its angle, and readings within their noise of it."""
    cell = kr270_cell(("base_frame", "joint_offset"))
    model, rng = Model.assembled(kr270_chain(), cell), np.random.default_rng(2)
    found = {p.name: p.value for p in EXPLAINED.effects[0].parameters}
    real = model.with_effects((*cell.model.effects, EffectChoice("gear_eccentricity", "joint2")))
    q = rng.uniform(*np.array(joint_limits(cell, model.chain)), (60, 6))
    x = np.array([found.get(n, v) for n, v in zip(real.names, real.nominal, strict=True)])
    observed = observe(simulate(real, model.table(q), x, rng, False), "position")
    read = observed.value + 1e-5 * rng.normal(size=observed.value.shape)
    B = model.regressor(observed.table, model.nominal, observations=observed).B
    left = read - model.predict(observed.table, model.nominal, observed)
    left = left - B @ np.linalg.lstsq(B, left, rcond=None)[0]
    base = Baseline(model, observed, model.nominal, np.ones(len(model.names)), left, left, None)
    (shape,) = effect_shapes(replace(EXPLAINED, calibrated=base, model=model))
    sin, cos = (found[f"joint2.eccentricity_{k}"] for k in ("sin", "cos"))
    expected = sin * np.sin(shape.q) + cos * np.cos(shape.q)
    np.testing.assert_allclose(shape.explained, expected, atol=1e-6)
    assert np.std(shape.seen - shape.explained) < 2e-5 < np.std(shape.explained)


def test_shade_of_the_chain_is_the_evidence(pages):
    chain = re.search(r'<svg class="chain".*?</svg>', pages["explained"], re.DOTALL)
    assert chain
    shades = [float(v) for v in re.findall(r'fill-opacity="([\d.]+)"', chain[0])]
    stages = EXPLAINED.location.stages
    order = ("transmission", "geometry", "load", "compliance", "tool", "tracker")
    expected = [0.45 * stages.get(stage, 0.0) for stage in order]
    assert shades == pytest.approx(expected, abs=1e-3)
    assert chain[0].count("likeliest") == 1
    unlocated = re.search(r'<svg class="chain".*?</svg>', pages["unlocated"], re.DOTALL)
    assert unlocated and "fill-opacity" not in unlocated[0]


def test_of_many_causes_the_chain_shows_shares_and_no_probabilities(pages):
    chain = re.search(r'<svg class="chain".*?</svg>', pages["many"], re.DOTALL)
    assert chain
    assert "97 %" in chain[0] and "5.0 %" in chain[0] and "0.98" not in chain[0]
    assert "Share of the gap that comes about in each link" in Page(pages["many"]).text


def test_places_stand_below_their_finding(pages):
    page = Page(pages["many"])
    rows = [row for row in page.rows if row]
    heads = [row[0] for row in rows]
    table = heads.index("place")
    first, second = (
        heads.index(name, table)
        for name in ("gear errors at joints 1, 2 and 5", "gravity sag at joints 2 and 3")
    )
    assert heads[first + 1 : second] == ["joint 2", "joint 1", "joint 5"]
    assert rows[first + 1][1:3] == ["against its own angle", "joint curve"]
    assert heads[second + 1 : second + 3] == ["joint 3", "joint 2"]


def test_extra_poses_in_people_s_units(pages):
    rows = [row for row in Page(pages["planned"]).rows if row and row[0] in "123" and len(row) > 9]
    assert [row[1] for row in rows] == ["X1", "X1", "X2"]
    q = np.degrees(EXTRA.plan.q)
    assert [[float(v) for v in row[2:8]] for row in rows] == pytest.approx(q, abs=0.005)
    assert [row[8] for row in rows] == ["0 0 0", "0 0 -2600", "0 0 -2600"]
    assert [row[9] for row in rows] == ["+ − + − + −"] * 3
    assert [row[10] for row in rows] == ["0.0", "10.0", "15.0"]


def test_numbers_that_are_not_known_do_not_break_the_page(model):
    steps = (
        BudgetStep("nominal", float("inf"), (float("nan"),) * 2),
        BudgetStep("a", 0.0, (0.0, 0.0)),
    )
    gap = replace(EXPLAINED.gap, noise_floor=float("nan"))
    Page(page_of(replace(EXPLAINED, model=model, budget=steps, gap=gap)))
    bare = replace(EXPLAINED, budget=(), candidates=(), structure=(), untested=(), warnings=())
    assert "<dt>Warnings" not in page_of(replace(bare, model=model))


def test_long_lists_are_cut_and_say_so(model):
    faulty = tuple(FaultyReading(i, "7", "M1", 1e-3, 10.0 + i) for i in range(130))
    d = replace(TWO, noise=replace(TWO.noise, faulty=faulty))
    page = Page(page_of(replace(d, model=model)))
    assert "and 30 more" in page.text
    assert [row[0] for row in page.rows if row and row[0] in ("129", "3")] == ["129"]


def test_same_diagnosis_same_page(model):
    found = replace(EXPLAINED, model=model)
    assert page_of(found) == page_of(found)


def test_writing_is_whole_or_not_at_all(model, tmp_path):
    found = replace(EXPLAINED, model=model)
    with pytest.raises(InputError, match="no such file"):
        write_page(found, tmp_path / "r.html", inputs=[tmp_path / "missing.csv"])
    with pytest.raises(InputError, match="does not exist"):
        write_page(found, tmp_path / "none" / "r.html")
    assert list(tmp_path.iterdir()) == []
