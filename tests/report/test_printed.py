"""print(result): a readable report with sensible digits, and never a line too long."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from support.diagnoses import VERDICTS

from elastocal.identification.findings import judged
from elastocal.report.diagnosis_terminal import print_diagnosis
from elastocal.report.judgement_view import judgement
from elastocal.report.terminal import PRINTED_WIDTH, print_result, printed_text


def test_an_identification_prints_its_parameters_and_what_they_are_worth(case: Any) -> None:
    text = str(case.result)
    assert text == printed_text(partial(print_result, details=True), case.result)
    for e in case.result.estimates:
        assert e.name in text
    assert judgement(case.result).headline in " ".join(text.split())
    assert "Prediction: At new poses" in text
    assert not re.search(r"e-0\d", text)  # units suit the sizes
    assert max(map(len, text.splitlines())) <= PRINTED_WIDTH
    assert not re.search(r"[ \t]$", text, re.MULTILINE) and "\x1b" not in text


def test_what_is_not_known_is_not_printed_as_infinite(case: Any) -> None:
    n = np.full_like(case.result.held_out, np.inf)
    text = " ".join(str(judged(replace(case.result, heldout_rms=np.inf, held_out=n))).split())
    assert "held-out poses not available" in text
    assert not re.search(r"\b(inf|nan)\b", text)


def test_digits_go_with_the_uncertainty(case: Any) -> None:
    """The last digit of a value is that of its half width, of which one or two are told."""
    found = re.findall(r"^ ?joint\d\.\S+ +(-?[\d.]+) +([\d.]+) +m?", str(case.result), re.MULTILINE)
    assert found
    for value, half in found:
        assert len(value.partition(".")[2]) == len(half.partition(".")[2])
        assert len(half.replace(".", "").lstrip("0")) <= 2


@pytest.mark.parametrize("name", VERDICTS)
def test_a_diagnosis_prints_verdict_budget_and_candidates(name: str) -> None:
    text = str(VERDICTS[name])
    assert text == printed_text(print_diagnosis, VERDICTS[name])
    assert text.startswith("Verdict: ")
    for head in ("Gap budget", "Candidates", "Noise: "):
        assert head in text
    assert max(map(len, text.splitlines())) <= PRINTED_WIDTH
    assert "\x1b" not in text
