"""The pages of results: complete, self-contained, harmless, brief, and written whole or not."""

from __future__ import annotations

import hashlib
import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED, HOSTILE, VERDICTS
from support.pages import Page

from elastocal.cell_tables import EffectChoice
from elastocal.diagnosis.baseline import Baseline
from elastocal.messages import InputError
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.plan import PlanSize
from elastocal.report import figures
from elastocal.report.renderers import page_of, write_page
from elastocal.simulation import simulate

SCRIPT = "<script>alert(1)</script>"


def seen(page: str, folded: bool = False) -> str:
    """The text of a page without its figures, and without what is folded."""
    page = re.sub(r"<(script|style|svg|head)\b.*?</\1>", " ", page, flags=re.S)
    if not folded:
        page = re.sub(r"<details><summary>(.*?)</summary>.*?</details>", r" \1 ", page, flags=re.S)
    return html.unescape(re.sub(r"<[^>]+>", " ", page))


def check_figures(page: str, count: int) -> None:
    """They are well-formed and follow the page's colours, each with ids of its own."""
    found = re.findall(r"<svg xmlns=.*?</svg>", page, re.DOTALL)
    assert len(found) == count
    for figure in found:
        ElementTree.fromstring(figure)
        assert "var(--ink)" in figure and "aria-label" in figure
        assert "#0102" not in figure and "mathdefault" not in figure
    ids = re.findall(r'\bid="([^"]*)"', page)
    assert len(ids) == len(set(ids))


def laid_out(case: Any) -> str:
    """The one page of these tests whose figures' labels do not overlap."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "LAYOUT", "constrained")
        return page_of(
            case.result, command="elastocal identify c.toml d.csv", seed=3, truth=case.truth
        )


def test_same_result_same_page_whatever_matplotlib_is_set_to(case: Any) -> None:
    page = laid_out(case)
    check_figures(page, 5)
    with mpl.rc_context({"text.usetex": True, "axes.facecolor": "red", "font.size": 30}):
        again = laid_out(case)
    # What evaluated the model so far is another thing the second time.
    engine = re.compile(r"<td class=\"name\">model evaluated by</td><td>.*?</td>")
    assert engine.sub("", again) == engine.sub("", page)


def test_names_from_files_are_text(hostile: Any) -> None:
    page = page_of(hostile.result, command="elastocal <b>", inputs={"<i>.csv": "<u>"})
    structure = Page(page)
    structure.check_harmless(page)
    assert not {"b", "i", "u"} & set(structure.tags)
    assert SCRIPT in structure.text and "[red]$x^2$ & " in structure.text
    (view,) = structure.data
    assert not set("<>&") & set(view)
    assert json.loads(view)["poses"][0]["names"][0] == SCRIPT
    assert len(seen(page).split()) <= 900


def test_an_identification_has_900_words_open_one_minus_sign_and_one_name_for_each_error(
    case: Any, shifted: Any, no_figures: None
) -> None:
    for each in (case, shifted):
        assert len(seen(page_of(each.result, truth=each.truth)).split()) <= 900
    page = seen(page_of(case.result), folded=True)
    assert "−" in page
    assert re.findall(r"(?<![\w.)\]-])-\d\S*", page) == []
    errors = set(re.findall(r"(nominal arm(?:, held out)?) +([\d.]+ [µm]m)", page))
    assert len(errors) == len({name for name, _ in errors}) == 2


@pytest.mark.parametrize("name", ["explained", "unknown", "many unknown"])
def test_a_diagnosis_is_harmless_and_has_700_words_open(name: str) -> None:
    shown = VERDICTS[name]
    model = Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))
    told = {"command": f"elastocal diagnose {HOSTILE}", "inputs": {HOSTILE: "0" * 64}, "seed": 7}
    found = replace(shown, model=model, data=HOSTILE)
    text = page_of(found, **told)
    page = Page(text)
    page.check_harmless(text)
    assert SCRIPT in page.text
    check_figures(text, 1 + bool(shown.curves))
    assert len(seen(text).split()) <= 700
    assert page_of(found, **told) == text


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
    shown = replace(EXPLAINED, calibrated=base, model=model)
    (figure,) = figures.effects_over_joints(shown)
    (axes,) = figures.figure_of(figure).axes
    (_, seen), (q, explained) = (line.get_data() for line in axes.lines[-2:])
    q, seen, explained = np.radians(q), 1e-6 * seen[::3], 1e-6 * np.asarray(explained)
    sin, cos = (found[f"joint2.eccentricity_{k}"] for k in ("sin", "cos"))
    expected = sin * np.sin(q) + cos * np.cos(q)
    np.testing.assert_allclose(explained, expected, atol=1e-6)
    assert np.std(seen - explained) < 2e-5 < np.std(explained)


def test_a_plan_shows_its_poses_and_has_600_words_open_with_every_stop(plan: Any) -> None:
    told = {"command": f"elastocal design {SCRIPT}", "inputs": {SCRIPT: "0" * 64}}
    text = page_of(replace(plan, curve=(PlanSize(4, 6.5, 6.1), PlanSize(8, 4.5, None))), **told)
    page = Page(text)
    page.check_harmless(text)
    assert len(text) < 6e6
    open_words = seen(page_of(plan))
    assert len(open_words.split()) <= 600
    assert open_words.count("☐") == len(plan.execution.stops) > 0
    (view,) = map(json.loads, page.data)
    assert [pose["name"] for pose in view["poses"]] == ["1", "2", "3", "4"]
    assert view["poses"][0]["names"][0] == SCRIPT and not view["arrows"]
    assert view["tracker"] == [3.0, 0.0, 1.0]
    local = np.array(list(plan.model.cell.tool.markers.values()))
    for pose, q in zip(view["poses"], plan.q, strict=True):
        assert f"q1 {np.degrees(q[0]):.2f} °" in pose["about"]
        # Markers are as far from the flange as the cell says.
        away = np.linalg.norm(np.subtract(pose["markers"], pose["line"][-1]), axis=1)
        assert away == pytest.approx(np.linalg.norm(local, axis=1), abs=2e-4)


def test_writing_is_whole_or_not_at_all_and_names_what_was_read(
    case: Any, no_figures: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data.csv"
    data.write_bytes(b"q1_deg\n1\n")
    for place, inputs, told in (("other.html", ["missing.csv"], "no such file"),
                                ("none/r.html", [], "does not exist")):  # fmt: skip
        with pytest.raises(InputError, match=told):
            write_page(case.result, tmp_path / place, inputs=[tmp_path / name for name in inputs])
    write_page(case.result, tmp_path / "r.html", inputs=str(data))
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert hashlib.sha256(data.read_bytes()).hexdigest() in text

    def full_disk(source: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(InputError, match="cannot be written"):
        write_page(case.result, tmp_path / "full.html")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data.csv", "r.html"]
