"""What the gap is made of in words: findings with their shares, places below, nothing twice."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.diagnoses import (
    CREEP,
    EXPLAINED,
    MANY,
    MANY_AMBIGUOUS,
    MANY_UNKNOWN,
    UNKNOWN,
    curve,
    part,
)

from elastocal.diagnosis.rivals import check_open
from elastocal.errors import InputError
from elastocal.report.causes_view import (
    added_text,
    cause_rows,
    causes,
    field_rows,
    place_rows,
    share_text,
    span_text,
)
from elastocal.report.diagnosis_view import (
    alike,
    diagnosis_headline,
    diagnosis_lines,
    diagnosis_steps,
    gap_rows,
)
from elastocal.report.effect_names import name_of, places, settings_text
from elastocal.report.figures import share_bars


def test_small_causes_are_counted_and_not_named():
    small = replace(MANY.groups[1], name="base_drift", places=("base",), share=0.004)
    text = diagnosis_headline(replace(MANY, groups=(*MANY.groups, small, small)))
    assert "and 2 smaller causes explain the gap" in text and "drift" not in text


def test_one_cause_alone_is_singular():
    alone = replace(MANY.groups[1], places=("joint2",))
    text = diagnosis_headline(replace(MANY, groups=(alone,)))
    assert text == "Gravity sag at joint 2 (12 % of the gap) explains the gap."
    gears = replace(MANY.groups[0], places=("joint2",))
    assert "joint 2 (82 % of the gap) explain the" in diagnosis_headline(
        replace(MANY, groups=(gears,))
    )


def test_a_finding_has_its_places_below_it_and_every_part_once():
    found = causes(MANY_UNKNOWN)
    assert [[c.where for c in cause.parts] for cause in found] == [
        ["joint2", "joint1", "joint5"], ["joint3", "joint2"], ["base"],
    ]  # fmt: skip
    rows = place_rows(MANY_UNKNOWN)
    assert len(rows.rows) == len(MANY_UNKNOWN.components)
    assert list(rows.groups) == [0, 3, 5]
    # An effect that two findings share a place with stands below one of them only.
    both = replace(MANY, groups=(MANY.groups[0], replace(MANY.groups[0], name="other")))
    kept = [c for c in MANY.components if c.family == "angle"]
    assert len(place_rows(both).rows) == len(kept)


def test_a_share_that_cancels_others_is_negative_and_drawn():
    parts = (*MANY.components, replace(part("load", "base", ("base_drift",), 0.03), share=-0.03,
                                       share_ci90=(-0.05, -0.01)))  # fmt: skip
    group = replace(MANY.groups[0], name="base_drift", places=("base",), effects=("base_drift",),
                    share=-0.03, share_ci90=(-0.05, -0.01))  # fmt: skip
    d = replace(MANY, components=parts, groups=(*MANY.groups, group))
    assert cause_rows(d).rows[-1][1:3] == ("−3.0 %", "−5.0 to −1.0 %")
    assert "svg" in share_bars(d)


def test_sentences_do_not_repeat_the_tables():
    labels = [label for label, _ in diagnosis_lines(MANY_AMBIGUOUS)]
    assert labels == ["Verdict", "Error", "Curves", "Chance"]
    text = dict(diagnosis_lines(MANY_AMBIGUOUS))
    assert "takes away" not in text["Error"]
    assert text["Curves"].endswith("span 0.596 mrad (joint 1) and 0.596 mrad (joint 2).")
    assert alike(MANY_AMBIGUOUS) == [
        "gear eccentricity at joint 5 (probability 0.58) and gear second harmonic at joint 5"
    ]


def test_every_family_is_a_phrase():
    families = ("angle", "gravity", "torque", "load", "move", "time", "temperature", "pose", "tool")
    d = replace(MANY, components=tuple(part(f, "joint2", ("joint_curve",), 0.1) for f in families))
    told = [row[1] for row in place_rows(d).rows]
    assert told == [
        "against its own angle", "by gravity", "by torque", "by load", "by the last move",
        "with time", "with temperature", "with the pose", "of the tool",
    ]  # fmt: skip


def test_budget_steps_of_groups_in_words():
    rows = [row[0] for row in gap_rows(MANY_UNKNOWN).rows]
    assert rows[3:] == [
        "gear errors at joints 1, 2 and 5", "gravity sag at joints 2 and 3",
        "what has no name at base", "noise alone",
    ]  # fmt: skip
    assert name_of("unknown:link1+base") == "what has no name at link 1 and base"
    assert name_of("rest") == "the smaller causes"
    assert name_of("thermal_expansion:link2+link3") == "thermal expansion of links 2 and 3"
    # A plus may belong to a marker's name.
    assert name_of("marker_slip:marker:M+1") == "marker slip of marker M+1"


@pytest.mark.parametrize(
    ("where", "runs", "text"),
    [
        (("joint2",), False, "joint 2"),
        (("joint3", "joint1", "joint2"), False, "joints 1, 2 and 3"),
        (("joint1", "joint2", "joint3", "joint5"), True, "joints 1 to 3 and 5"),
        (("joint1", "joint2"), True, "joints 1 and 2"),
        (("link2", "base", "link3"), False, "links 2 and 3 and base"),
        (("marker:joint1",), False, "marker joint1"),
        (("all",), True, "all links"),
    ],
)
def test_places(where, runs, text):
    assert places(where, runs) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.553, "55 %"), (1.004, "100 %"), (0.0161, "1.6 %"), (0.0002, "< 0.1 %"), (-0.012, "−1.2 %"),
     (float("nan"), "–"), (0.0, "0.0 %"), (-0.0002, "0.0 %")],
)  # fmt: skip
def test_shares(share, text):
    assert share_text(share) == text


def test_an_interval_is_as_fine_as_its_middle():
    assert span_text((0.05, 0.13), 0.08) == "5.0 to 13.0 %"
    assert span_text((0.05, 0.13), 0.11) == "5 to 13 %"


def test_corrections_without_a_name_and_what_they_follow():
    d = replace(MANY_UNKNOWN, fields=(CREEP, curve(2, 3.2e-4)))
    assert [row[:4] for row in field_rows(d).rows] == [
        ("base", "the time", "0.040 mm, mrad", "90.0 min"),
        ("joint 2", "its own angle", "0.32 mrad", "4.01°"),
    ]
    two = {"field_joint1_size": 1e-4, "field_joint1_length": 1.0, "field_joint3_size": 2e-4,
           "field_joint3_length": 0.5}  # fmt: skip
    first, second = field_rows(replace(d, fields=(replace(CREEP, settings=two),))).rows
    assert first[1:] == ("the angle of joint 1", "0.10 mm, mrad", "57.3°", "5.0 %", "2.0 to 8.0 %")
    assert second[1:] == ("the angle of joint 3", "0.20 mm, mrad", "28.6°", "", "")


def test_settings_of_a_curve_are_short():
    text = settings_text(curve(2, 3.2e-4).settings)
    assert text == "from −166° to 28.6°, size 0.320 mrad, length 4.01°"
    assert settings_text({"sag_size_rad": 2.2e-4}) == "sag size 0.220 mrad"


def test_orders_of_a_spectrum_have_their_uncertainty_and_do_not_drown_the_rest():
    lines = {f"order_{n}": 18.5193 * n for n in range(1, 9)}
    sds = {f"order_sd_{n}": 0.012 * n for n in range(1, 9)}
    size = {"spectrum_size_rad": 5e-5, "spectrum_centre_rad": -0.3}
    text = settings_text(size | lines | sds)
    assert text.startswith("spectrum size 0.0500 mrad, orders 18.519 ± 0.024, 37.04 ± 0.05, ")
    assert text.endswith("and 2 more") and "centre" not in text
    assert settings_text({"order_1": 2.0}) == "order 2.000"


def test_a_written_cell_is_told_in_short_where_much_was_added():
    few = MANY.effects[:2]
    assert added_text(few) == "joint_curve:joint2, joint_curve:joint1"
    many = (*MANY.effects, CREEP, curve(4, 1e-4))
    assert added_text(many) == (
        "joint_curve (joints 1, 2 and 4), gravity_sag (joints 2 and 3), gear_eccentricity "
        "(joint 5), residual_field (base)"
    )


def test_the_findings_of_many_causes():
    first, second, *_ = MANY.findings
    assert (first.kind, first.severity) == ("explained", "good")
    assert second.kind == "many_causes" and not second.remedy
    assert second.listed("groups") == (
        "gear_errors:joint1+joint2+joint5", "gravity_sag:joint2+joint3",
    )  # fmt: skip
    assert second.listed("shares_low") == (0.79, 0.09)
    assert "many_causes" not in {f.kind for f in EXPLAINED.findings}


def test_what_to_do_with_smooth_corrections_is_said_once():
    (step,) = [line for line in diagnosis_steps(MANY_UNKNOWN) if "`cell_out`" in line]
    assert "the effects named and smooth corrections for what has no name" in step
    assert "explain nothing" in step and "identify with `test`" in step
    alone = replace(UNKNOWN, fields=(CREEP,))
    (step,) = [line for line in diagnosis_steps(alone) if "`cell_out`" in line]
    assert "has smooth corrections" in step and "effects named" not in step


def test_extra_poses_are_not_promised_for_many_causes():
    assert not MANY_AMBIGUOUS.open
    text = " ".join(diagnosis_steps(MANY_AMBIGUOUS))
    assert "extra.csv" not in text and "the whole range of every joint" in text
    with pytest.raises(InputError, match="many causes act at once"):
        check_open(MANY_AMBIGUOUS)


def test_in_short_the_groups_are_named_and_not_each_effect():
    assert repr(MANY) == (
        "<Diagnosis: explained, gear_errors at joint1 joint2 joint5, gravity_sag at joint2 joint3>"
    )
