"""The diagnosis in a terminal, wide or narrow."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from support.diagnoses import EXPLAINED, EXTRA, VERDICTS

from elastocal.report.diagnosis_terminal import MOST_CANDIDATES_PRINTED, print_diagnosis

KINDS = ("revolute",) * 6


def printed(name: str, width: int) -> str:
    out = io.StringIO()
    print_diagnosis(Console(file=out, width=width), VERDICTS[name], KINDS)
    return out.getvalue()


@pytest.mark.parametrize("width", [60, 80, 140])
@pytest.mark.parametrize("name", VERDICTS)
def test_it_fits_and_obeys_no_control_character(name, width):
    text = printed(name, width)
    assert max(map(len, text.splitlines())) <= width
    assert "\x1b" not in text
    words = " ".join(text.split())
    for part in ("Verdict:", "Gap budget", "the best 8 of 10", "Noise:", "Next:"):
        assert part in words


def test_every_step_and_the_best_candidates_are_listed():
    text = printed("explained", 140)
    for step in ("nominal", "base frame", "joint offset", "gear eccentricity at joint 2"):
        assert step in text
    listed = [c.effect.replace("_", " ") in text for c in EXPLAINED.candidates]
    assert listed == [True] * MOST_CANDIDATES_PRINTED + [False] * 2
    assert "joint2.eccentricity_sin" in text and "mrad" in text
    assert "no further effect" in text and "an effect outside the catalogue" in text


def test_searched_constants_stand_where_there_is_room():
    assert "ripple order 100.7" in printed("explained", 140)
    assert "ripple order 100.7" not in printed("explained", 80)


def test_alike_untested_and_rivals():
    text = " ".join(printed("planned", 140).split())
    assert "link mass error of link 2: these data cannot tell them apart" in text
    assert "the table has no approach direction" in text
    before, after = EXTRA.pairs[0].distance_before, EXTRA.pairs[0].distance_after
    assert f"gear eccentricity at joint 2 or link mass error of link 2 {before} {after}" in text
