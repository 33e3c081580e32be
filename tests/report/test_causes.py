"""What the gap is made of in words: findings with their shares, places below, nothing twice."""

from __future__ import annotations

from dataclasses import replace

from support.diagnoses import MANY, MANY_UNKNOWN

from elastocal.report.diagnosis_view import place_table


def test_a_finding_has_its_places_below_it_and_every_part_once():
    rows = place_table(MANY_UNKNOWN)
    assert len(rows.rows) == len(MANY_UNKNOWN.components)
    assert list(rows.groups) == [0, 3, 5]
    at = ["joint 2", "joint 1", "joint 5", "joint 3", "joint 2", "base"]
    assert [row[0] for row in rows.rows] == at
    # An effect that two findings share a place with stands below one of them only.
    both = replace(MANY, groups=(MANY.groups[0], replace(MANY.groups[0], name="other")))
    kept = [c for c in MANY.components if c.family == "angle"]
    assert len(place_table(both).rows) == len(kept)
