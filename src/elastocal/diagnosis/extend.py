"""The model with found effects added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from elastocal.cell import Cell
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_cache import made_once
from elastocal.diagnosis.model_set import Item
from elastocal.manipulator.model import Model


def extended(model: Model, items: Sequence[Item]) -> Model:
    """The model with the effects of the known items active, at their settings."""
    spec = model.cell.model
    settings = {place: dict(values) for place, values in spec.nominal.settings.items()}
    effects = list(spec.effects)
    for item in items:
        if not isinstance(item.what, Hypothesis):
            continue
        effects.append(item.what.choice)
        for setting, value in zip(item.what.settings, item.settings, strict=True):
            settings.setdefault(item.what.where, {})[setting.key] = float(value)
    nominal = replace(spec.nominal, settings=settings)
    cell: Cell = replace(model.cell, model=replace(spec, effects=tuple(effects), nominal=nominal))
    key = "extended", tuple(effects), repr(settings)
    return made_once(model, key, lambda: Model.assembled(model.chain, cell))


def settings_of(item: Item) -> dict[str, float]:
    """Searched constants of a known item by their keys."""
    if not isinstance(item.what, Hypothesis):
        return {}
    keys = [s.key for s in item.what.settings]
    return {k: float(v) for k, v in zip(keys, item.settings, strict=True)}
