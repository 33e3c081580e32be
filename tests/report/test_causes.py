"""What the gap is made of in words: findings with their shares, places below, nothing twice."""

from __future__ import annotations

from dataclasses import replace

from support.diagnoses import MANY, MANY_UNKNOWN

from elastocal.report.diagnosis_view import causes, place_table


def test_a_finding_has_its_places_below_it_and_every_part_once():
    found = causes(MANY_UNKNOWN)
    assert [[c.where for c in cause.parts] for cause in found] == [
        ["joint2", "joint1", "joint5"], ["joint3", "joint2"], ["base"],
    ]  # fmt: skip
    rows = place_table(MANY_UNKNOWN)
    assert len(rows.rows) == len(MANY_UNKNOWN.components)
    assert list(rows.groups) == [0, 3, 5]
    # An effect that two findings share a place with stands below one of them only.
    both = replace(MANY, groups=(MANY.groups[0], replace(MANY.groups[0], name="other")))
    kept = [c for c in MANY.components if c.family == "angle"]
    assert len(place_table(both).rows) == len(kept)
