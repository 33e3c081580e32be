"""How much a page says before anything is unfolded, and in which signs."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from typing import Any

import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import VERDICTS

from elastocal.model.manipulator import Model
from elastocal.report.page import page_of

pytestmark = pytest.mark.usefixtures("no_figures")


def seen(page: str, folded: bool = False) -> str:
    """The text of a page without its figures, and without what is folded."""
    page = re.sub(r"<(script|style|svg|head)\b.*?</\1>", " ", page, flags=re.S)
    if not folded:
        page = re.sub(r"<details><summary>(.*?)</summary>.*?</details>", r" \1 ", page, flags=re.S)
    return html.unescape(re.sub(r"<[^>]+>", " ", page))


def test_an_identification_has_900_words_open(case: Any, shifted: Any, hostile: Any) -> None:
    for each in (case, shifted, hostile):
        assert len(seen(page_of(each.result, truth=each.truth)).split()) <= 900


@pytest.mark.parametrize("name", VERDICTS)
def test_a_diagnosis_has_700_words_open(name: str) -> None:
    model = Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))
    assert len(seen(page_of(replace(VERDICTS[name], model=model))).split()) <= 700


def test_a_page_has_one_kind_of_minus_sign_and_one_name_for_each_error(case: Any) -> None:
    page = seen(page_of(case.result), folded=True)
    assert "−" in page
    assert re.findall(r"(?<![\w.)\]-])-\d\S*", page) == []
    errors = set(re.findall(r"(nominal arm(?:, held out)?) +([\d.]+ [µm]m)", page))
    assert len(errors) == len({name for name, _ in errors}) == 2


def test_a_changed_arm_has_the_tone_of_a_warning() -> None:
    """The style sheet knows each tone that a verdict can have."""
    from elastocal.report.blocks import TONES
    from elastocal.report.page import resource

    css = resource("style.css")
    assert all(f".judgement.{tone}" in css for tone in TONES.values())
