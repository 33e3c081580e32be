"""What is tried, what cannot be, and what to record so that it can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.diagnosis_data import campaign

from elastocal.diagnosis.diagnose import DiagnosisOptions
from elastocal.diagnosis.hypotheses import possible
from elastocal.errors import InputError
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model

MODEL, TABLE = campaign()
ISSUE = {
    "encoder_scale", "gear_eccentricity", "gear_second_harmonic", "gear_ripple", "wrist_coupling",
    "backlash", "hysteresis", "joint_hardening", "off_axis_compliance", "link_bending",
    "base_compliance", "gravity_compensator", "payload_error", "link_mass_error",
    "thermal_expansion", "base_drift", "joint_drift", "encoder_jump", "frame_jump", "marker_slip",
    "tracker_distortion",
}  # fmt: skip


def test_the_whole_catalogue_is_tried_where_everything_is_recorded() -> None:
    tried, untested = possible(MODEL, TABLE)
    assert {h.name for h in tried} >= ISSUE
    assert untested == []
    assert len({(h.name, h.where) for h in tried}) == len(tried)
    for joint in range(1, 7):
        assert ("gear_eccentricity", f"joint{joint}") in {(h.name, h.where) for h in tried}


LACKING = {
    "time": ("joint_drift", "base_drift", "encoder_jump", "frame_jump", "marker_slip"),
    "approach": ("hysteresis",),
}


@pytest.mark.parametrize("column", LACKING)
@pytest.mark.parametrize("how", ["absent", "constant"])
def test_what_the_table_does_not_say_is_untested_with_advice(column: str, how: str) -> None:
    """A column that never changes says as little as none."""
    values = None if how == "absent" else np.ones_like(getattr(TABLE, column))
    tried, untested = possible(MODEL, replace(TABLE, **{column: values}))
    names = {u.effect for u in untested}
    assert names >= set(LACKING[column]) and not names & {h.name for h in tried}
    assert all(column in u.reason or "side" in u.reason for u in untested)
    assert all("record" in u.advice and column in u.advice for u in untested)
    complete = {(h.name, h.where) for h in possible(MODEL, TABLE)[0]}
    # Without sides the order of the visits has to say them.
    parts = {(h.name, h.where) for h in tried if h.name != "move_hysteresis"}
    parts |= {(u.effect, u.where) for u in untested}
    assert parts == complete


@pytest.mark.parametrize("name", sorted(ISSUE))
def test_an_effect_can_be_taken_out_of_the_catalogue(name: str) -> None:
    whole = {(h.name, h.where) for h in possible(MODEL, TABLE)[0]}
    rest = {(h.name, h.where) for h in possible(MODEL, TABLE, (name,))[0]}
    assert rest == {key for key in whole if key[0] != name} < whole


def test_a_misspelt_effect_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(InputError, match="gear_eccentricity"):
        DiagnosisOptions(without=("gear_excentricity",))
    with pytest.raises(InputError, match="false_alarm"):
        DiagnosisOptions(false_alarm=0.0)
    assert DiagnosisOptions(without=tuple(CATALOGUE)).without == tuple(CATALOGUE)


def test_an_instrument_does_not_stand_among_the_markers() -> None:
    """Readings about the origin were turned into another frame: nothing says where the instrument
    stood, unless the cell does."""
    plain = MODEL.cell
    silent = Model.assembled(
        MODEL.chain, replace(plain, tracker=replace(plain.tracker, position=np.zeros(3)))
    )
    around = TABLE.position - TABLE.position.mean(axis=0)
    aside = around + np.array([4.0, 0.0, 0.0])
    key = ("tracker_distortion", "tracker")
    for model, position, asked in (
        (silent, around, False), (silent, aside, True), (MODEL, around, True),
    ):  # fmt: skip
        tried, untested = possible(model, replace(TABLE, position=position))
        assert (key in {(h.name, h.where) for h in tried}) == asked
        (*_, advice) = [u.advice for u in untested if u.effect == key[0]] or ["position_m"]
        assert "position_m" in advice
