"""What a diagnosis says in words: never more than it knows, never a raw name."""

from __future__ import annotations

import math
import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.diagnoses import (
    EXPLAINED,
    NOTHING,
    VERDICTS,
)

from elastocal.report.diagnosis_view import (
    diagnosis_lines,
    diagnosis_steps,
    gap_table,
    noise_floor_lines,
    sensitivity,
)
from elastocal.report.formatting import probability, settings_text

KINDS = ("revolute",) * 6


def spoken(d):
    return " ".join(text for _, text in diagnosis_lines(d)) + " ".join(diagnosis_steps(d))


def test_a_range_of_angles_has_one_unit():
    told = settings_text({"curve_low_rad": 0.0, "curve_high_rad": 0.00391, "curve_size_rad": 1e-4})
    assert told == "from 0° to 0.224°, size 0.100 mrad"


def test_the_smallest_effect_that_shows_has_distance_five():
    """d of a displacement field of the told size, computed from readings, is 5."""
    (line, _) = sensitivity(NOTHING)
    (told,) = re.findall(r"above about ([\d.]+) µm", line)
    field = np.random.default_rng(1).normal(size=(NOTHING.n_configurations, 3))
    field *= float(told) * 1e-6 / math.sqrt((field**2).sum(axis=1).mean())
    sigma = NOTHING.gap.noise_floor / math.sqrt(3)
    assert np.linalg.norm(field / sigma) == pytest.approx(5, rel=0.02)


@pytest.mark.parametrize("name", VERDICTS)
def test_nothing_that_a_terminal_obeys_and_no_raw_names(name):
    d = VERDICTS[name]
    text = spoken(d) + " ".join(noise_floor_lines(d.noise, KINDS))
    assert "\x1b" not in text
    assert not re.search(r"\b(joint|link)[0-9]", text)
    assert "gear_" not in text


@given(st.floats(0, 1))
def test_a_probability_is_never_told_as_certain(p):
    text = probability(p)
    assert text not in ("0.00", "1.00")
    number = float(text.strip("<> "))
    assert abs(number - p) <= 0.0101


def test_budget_changes_add_up():
    """Change of every step, read back from its text, is the difference of the errors."""
    table = gap_table(EXPLAINED).rows
    assert table[-1][:2] == ("noise alone", "19.0 µm")
    scale = {"mm": 1e-3, "µm": 1e-6}

    def read(text):
        number, unit = text.split()
        return float(number) * scale[unit]

    for before, after in pairwise(table[:-1]):
        assert read(after[3]) == pytest.approx(read(after[1]) - read(before[1]), rel=0.01)
