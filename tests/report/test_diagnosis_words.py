"""What a diagnosis says in words: never more than it knows, never a raw name."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.diagnoses import (
    AMBIGUOUS,
    CANDIDATES,
    ECCENTRICITY,
    EXPLAINED,
    EXTRA,
    INSEPARABLE,
    NOTHING,
    RIVALS,
    UNKNOWN,
    VERDICTS,
)

from elastocal.diagnosis.diagnosis import EffectAt, NearRepeats, NoiseFloor
from elastocal.report.diagnosis_view import (
    diagnosis_headline,
    diagnosis_lines,
    diagnosis_steps,
    gap_rows,
    hypothesis_rows,
    noise_floor_lines,
    seen_from,
    sensitivity,
)
from elastocal.report.effect_names import (
    effect_at,
    name_of,
    p_value,
    probability,
    reduction,
    settings_text,
)
from elastocal.report.formatting import together

KINDS = ("revolute",) * 6


def spoken(d):
    return " ".join(text for _, text in diagnosis_lines(d)) + " ".join(diagnosis_steps(d))


def test_an_ambiguous_verdict_names_the_whole_set_and_the_way_out():
    text = spoken(AMBIGUOUS)
    assert diagnosis_headline(AMBIGUOUS) == (
        "Either gear eccentricity at joint 2 or link mass error of link 2 makes the gap; these "
        "data cannot tell which."
    )
    assert "explain" not in text
    assert "Gear eccentricity at joint 2 (probability" not in diagnosis_headline(AMBIGUOUS)
    assert "plan='extra.csv'" in text


def test_an_effect_that_is_certain_beside_an_open_set_is_told_apart_from_it():
    sure = replace(ECCENTRICITY, effect="encoder_jump", where="joint1", probability=0.99)
    d = replace(AMBIGUOUS, effects=(*AMBIGUOUS.effects, sure))
    labels = {label for label, text in diagnosis_lines(d) if "encoder jump" in text}
    assert "Besides" in labels and "Likeliest" not in labels
    assert ("Likeliest", "gear eccentricity at joint 2 (probability 0.58).") in diagnosis_lines(d)


def test_two_open_sets_are_two_questions():
    pair = (EffectAt("joint_drift", "joint1"), EffectAt("base_drift", "base"))
    text = diagnosis_headline(replace(AMBIGUOUS, indistinguishable=(*RIVALS, pair)))
    assert "and either joint drift at joint 1 or base drift make the gap" in text


def test_an_unknown_effect_has_a_place_a_driver_and_a_chance_but_no_name():
    text = spoken(UNKNOWN)
    assert "joint 2, in the transmission (probability 0.98)" in text
    assert "joint 2 angle (p = 0.0040)" in text
    assert "p = 0.00040" in text
    # The curve is 80 µrad · sin(3q) over more than a turn of its argument.
    assert "Shape" in dict(diagnosis_lines(UNKNOWN))
    (moved,) = re.findall(r"joint 2 angle moves joint 2 rotation by ([\d.]+) mrad", text)
    assert float(moved) == pytest.approx(0.16, rel=0.01)
    # Tests that the whole family explains by chance are not told as findings.
    assert "joint 3 torque" not in text and "load (p" not in text
    assert not any(effect_at(c) in text for c in UNKNOWN.candidates)
    assert "plan='extra.csv'" in text


def test_what_is_named_beside_something_unknown_has_to_prove_itself():
    beside = replace(UNKNOWN, effects=EXPLAINED.effects)
    (step,) = [line for line in diagnosis_steps(beside) if "`cell_out`" in line]
    assert "effects named" in step and "identify with `test`" in step
    assert all(effect_at(f) in diagnosis_headline(beside).lower() for f in EXPLAINED.effects)
    assert not any("`cell_out`" in line for line in diagnosis_steps(UNKNOWN))


def test_the_smallest_effect_that_shows_has_distance_five():
    """d of a displacement field of the told size, computed from readings, is 5."""
    (line, _) = sensitivity(NOTHING)
    (told,) = re.findall(r"more than about ([\d.]+) µm", line)
    field = np.random.default_rng(1).normal(size=(NOTHING.n_configurations, 3))
    field *= float(told) * 1e-6 / math.sqrt((field**2).sum(axis=1).mean())
    sigma = NOTHING.gap.noise_floor / math.sqrt(3)
    assert np.linalg.norm(field / sigma) == pytest.approx(5, rel=0.02)


@pytest.mark.parametrize(
    ("d", "text"), [(50.0, "0.10"), (5.0, "1.0"), (0.1, "50"), (0.01, "> 100"), (0.0, "–")]
)
def test_a_size_that_no_arm_has_is_not_given_as_a_number(d: float, text: str):
    assert seen_from(replace(CANDIDATES[0], detectable=d)) == text


def test_extra_poses_promise_or_say_that_none_helps():
    promise = " ".join(diagnosis_steps(replace(AMBIGUOUS, extra=EXTRA)))
    assert "2 more poses" in promise and "from 0.69 to > 0.99" in promise and "0.85" in promise
    assert "plan='extra.csv'" not in promise
    assert "count as one" not in promise
    grouped = replace(EXTRA, inseparable=(("backlash:joint2", "encoder_scale:joint2"),))
    lines = diagnosis_steps(replace(AMBIGUOUS, extra=grouped))
    assert "Backlash at joint 2 and encoder scale at joint 2 count as one." in lines
    hopeless = " ".join(diagnosis_steps(replace(AMBIGUOUS, extra=INSEPARABLE)))
    assert "No pose that this cell allows tells apart gear eccentricity at joint 2" in hopeless
    assert "rises" not in hopeless


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


def test_numbers_that_are_not_known():
    assert probability(math.nan) == p_value(math.nan) == "–"
    assert reduction(replace(ECCENTRICITY, gap_reduction_ci95=(math.nan, math.nan))) == "75 %"


@pytest.mark.parametrize(
    ("e", "text"),
    [
        (("base_drift", "base"), "base drift"),
        (("tracker_distortion", "tracker"), "tracker distortion"),
        (("thermal_expansion", "all"), "thermal expansion of all links"),
        (("link_bending", "link12"), "link bending of link 12"),
        (("marker_slip", "marker:M_1 joint2"), "marker slip of marker M_1 joint2"),
    ],
)
def test_names(e, text):
    assert effect_at(EffectAt(*e)) == text
    assert name_of(":".join(e)) == name_of(" at ".join(e)) == text


def test_names_that_are_no_effects():
    assert name_of("base_frame") == "base frame"
    assert name_of("joint2 angle") == "joint 2 angle"


def test_settings_have_units():
    text = settings_text({"jump_time_s": 4325.5, "ripple_order": 100.7, "time_constant_s": 60.0})
    assert text == "jump time 72.1 min, ripple order 100.7, time constant 60.0 s"


def test_near_repeats_are_told_with_their_number():
    bare = NoiseFloor(False, 1.0, 1.0, 2e-5, (0.0,) * 6, 0.0, None)

    def told(near):
        return " ".join(noise_floor_lines(replace(bare, near_repeats=near), KINDS))

    assert "nearly the same pose (1 pair) scatter by 26.0 µm rms" in told(NearRepeats(26e-6, 1, 1))
    text = told(NearRepeats(26e-6, 40, 35, 20e-6, 31e-6))
    assert "(40 pairs)" in text and "soon after each other 20.0 µm" in text and "31.0 µm)" in text


@pytest.mark.parametrize("d", [EXPLAINED, NOTHING])
def test_what_is_no_noise_is_called_unexplained(d):
    assert "unexplained" not in spoken(d)
    text = spoken(replace(d, gap=replace(d.gap, unexplained=0.2e-3)))
    assert "200 µm rms look like scatter of the arm and are no noise" in text


def test_lists():
    assert [together(["a", "b", "c"][:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]


def test_budget_changes_add_up():
    """Change of every step, read back from its text, is the difference of the errors."""
    table = gap_rows(EXPLAINED).rows
    assert table[-1][:2] == ("noise alone", "19.0 µm")
    scale = {"mm": 1e-3, "µm": 1e-6}

    def read(text):
        number, unit = text.replace("−", "-").split()
        return float(number) * scale[unit]

    for before, after in pairwise(table[:-1]):
        assert read(after[3]) == pytest.approx(read(after[1]) - read(before[1]), rel=0.01)


def test_candidates_seen_from_five_standard_deviations():
    table = hypothesis_rows(EXPLAINED, 10).rows
    for row, c in zip(table[:10], CANDIDATES, strict=True):
        if c.detectable:
            assert float(row[4]) * c.detectable == pytest.approx(5, rel=0.05)
        else:
            assert row[4] == "–"
    assert [row[0] for row in table[10:]] == [
        "an effect outside the catalogue",
        "no further effect",
    ]


def test_noise_without_repeats_statement_or_faults():
    bare = NoiseFloor(False, 1.0, 1.0, 2e-5, (0.0,) * 6, 0.0, None)
    text = " ".join(noise_floor_lines(bare, KINDS))
    assert "nothing was stated" in text and "none that shows" in text
    assert "No reading is repeated" in text
    assert "faulty" not in text and "share" not in text
    mixed = replace(bare, repeatability=(1e-6,) * 6)
    text = " ".join(noise_floor_lines(mixed, ("prismatic", *KINDS[1:])))
    assert "joint 1 1.0 µm, joint 2 1.0 µrad" in text
