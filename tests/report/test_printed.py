"""print(result): a readable report with sensible digits, and never a line too long."""

from __future__ import annotations

import re
from typing import Any


def test_digits_go_with_the_uncertainty(case: Any) -> None:
    """The last digit of a value is that of its half width, of which one or two are told."""
    found = re.findall(r"^ ?joint\d\.\S+ +(-?[\d.]+) +([\d.]+) +m?", str(case.result), re.MULTILINE)
    assert found
    for value, half in found:
        assert len(value.partition(".")[2]) == len(half.partition(".")[2])
        assert len(half.replace(".", "").lstrip("0")) <= 2
