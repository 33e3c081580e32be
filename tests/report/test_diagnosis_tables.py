"""The diagnosis in a terminal, wide or narrow."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from support.diagnoses import VERDICTS

from elastocal.report.terminal import print_report


def printed(name: str, width: int) -> str:
    out = io.StringIO()
    print_report(Console(file=out, width=width), VERDICTS[name])
    return out.getvalue()


@pytest.mark.parametrize("width", [60])
@pytest.mark.parametrize("name", VERDICTS)
def test_it_fits_and_obeys_no_control_character(name, width):
    text = printed(name, width)
    assert max(map(len, text.splitlines())) <= width
    assert "\x1b" not in text
    words = " ".join(text.split())
    for part in ("Verdict:", "Error budget", "rank 1 to 8 of 10", "Noise:", "Next:"):
        assert part in words
