"""Models that are derived from another one are made once, and no more of them kept than needed."""

from __future__ import annotations

import gc
import weakref

import numpy as np
from support.diagnosis_data import campaign

from elastocal.diagnosis import Hypothesis, Item, extended, made_once, possible
from elastocal.diagnosis.baseline import MOST
from elastocal.model import Model


def small() -> Model:
    return campaign(n=8)[0].rigid


def copy(model: Model) -> Model:
    return Model.assembled(model.chain, model.cell)


def test_a_model_is_made_once_for_a_key_and_anew_for_another() -> None:
    model = small()
    first = made_once(model, "a", lambda: copy(model))
    assert made_once(model, "a", lambda: copy(model)) is first
    assert made_once(model, "b", lambda: copy(model)) is not first
    other = copy(model)
    assert made_once(other, "a", lambda: copy(model)) is not first


def test_those_asked_for_last_are_kept() -> None:
    model = small()
    often = made_once(model, "often", lambda: copy(model))
    once = made_once(model, "once", lambda: copy(model))
    for k in range(MOST):
        made_once(model, k, lambda: copy(model))
        assert made_once(model, "often", lambda: copy(model)) is often
    assert made_once(model, "once", lambda: copy(model)) is not once


def test_what_is_kept_goes_with_the_model_it_was_made_of() -> None:
    original = small()
    model = copy(original)
    observed = weakref.ref(made_once(model, "a", lambda: copy(original)))
    assert observed() is not None
    del model
    gc.collect()
    assert observed() is None


def test_a_model_with_other_settings_is_another_model() -> None:
    model, table = campaign(n=8)
    (h,) = [h for h in possible(model, table)[0] if (h.name, h.where) == ("gear_ripple", "joint5")]
    assert isinstance(h, Hypothesis)

    def with_order(order: float) -> Model:
        return extended(model, [Item(h, np.array([order]), 0.0)])

    assert with_order(81.0) is with_order(81.0)
    assert with_order(81.0) is not with_order(81.0 + 1e-9)
