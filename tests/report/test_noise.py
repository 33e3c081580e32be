"""What the report says of noise and method: names from the result are text."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from support.pages import Page

from elastocal.identification.findings import judged
from elastocal.identification.noise_choice import Trial
from elastocal.identification.noise_summary import NoiseSize
from elastocal.report.page import page_of
from elastocal.report.terminal import printed_text


def test_names_from_the_result_are_text(case: Any, no_figures: None) -> None:
    script = "<script>\x1b[31m"
    noise = replace(
        case.result.noise, description=script, reason=script,
        sizes=(NoiseSize(script, 1e-6), NoiseSize("rz", 5e-6)),
        tried=tuple(Trial(script, 1, float(k)) for k in range(2)),
    )  # fmt: skip
    changed = judged(replace(case.result, method="reml", noise=noise))
    page = page_of(changed)
    found = Page(page)
    found.check_harmless(page)
    assert script.replace("\x1b", "\\x1b") in found.text
    assert "\x1b" not in printed_text(changed)
