"""What effects say of themselves, and what is assumed of one that says nothing."""

from __future__ import annotations

import pytest
from support.cells import kr270_cell
from support.registered import forgotten

from elastocal.errors import InputError
from elastocal.model.effects.base import Effect, JointMotion, Symbols
from elastocal.model.effects.catalogue import CATALOGUE, register


class Stranger(JointMotion):
    """Nothing but what every effect must state."""

    name = "stranger"


@pytest.mark.parametrize("observe", ["position", "pose", "distance"])
def test_what_a_diagnosis_may_suspect_and_what_acts_unasked(observe: str) -> None:
    cell = kr270_cell((), observe, link_gravity=True)
    never = {n for n, e in CATALOGUE.items() if not e.may_be_missing(cell)}
    only = {"marker_orientation": "pose", "distance_sensor": "distance"}
    together = {  # judged with all other components of the gap
        "joint_curve", "residual_field", "gear_spectrum", "gravity_sag", "link_weights",
        "torque_coupling", "torque_tilt",
    }  # fmt: skip
    loads = {"payload", "link_gravity"}
    assert never == loads | together | {n for n, o in only.items() if o != observe}
    assert {n for n, e in CATALOGUE.items() if e.acts_unasked(cell)} == {"payload", "link_gravity"}
    light = kr270_cell((), observe)
    assert {n for n, e in CATALOGUE.items() if e.acts_unasked(light)} == {"payload"}


def test_a_name_is_taken_once_but_by_the_same_class() -> None:
    class Other(JointMotion):
        name = "stranger"

    with forgotten():
        register(Stranger())
        again = Stranger()
        register(again)
        assert CATALOGUE["stranger"] is again
        with pytest.raises(InputError, match="there is an effect 'stranger' already"):
            register(Other())


class Unplaced(Effect):
    name = "unplaced"
    stage = "tool"

    def read(self, arm: object, place: str, p: Symbols) -> None:  # type: ignore[override]
        pass


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"name": "Big"}, "name takes lower-case letters"),
        ({"stage": "gears"}, "stage takes transmission, geometry"),
        ({"formats": ("urdf",)}, "formats takes rigid, elastic"),
        (
            {"needs": ("wind",)},
            "needs takes time, .*, load, torque; found 'wind'",
        ),
    ],
)
def test_what_is_stated_wrongly_is_named(changes: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        register(type("Wrong", (Stranger,), changes)())


def test_an_effect_without_places_is_refused() -> None:
    with pytest.raises(InputError, match=r"Unplaced lacks places; it states where it can act"):
        register(Unplaced())
