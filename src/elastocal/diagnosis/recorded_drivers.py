"""What the table records decides how some effects are driven."""

from __future__ import annotations

from dataclasses import replace

from elastocal.diagnosis.hypotheses import recorded
from elastocal.diagnosis.result import Diagnosis, FoundEffect
from elastocal.manipulator.effects.changes_in_time import ThermalExpansion
from elastocal.manipulator.effects.play import Backlash
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

# Key of [model], its value, the column that allows it, and the effect that it is about.
CHOICES = (
    ("thermal_driver", "temperature", "temperature", ThermalExpansion.name),
    ("play_side", "load_and_approach", "approach", Backlash.name),
)


def with_recorded_drivers(
    model: Model, table: Measurements, found: Diagnosis | None = None
) -> Model:
    """The model with effects driven by the best that the table records.

    Growth follows a measured temperature rather than a warm-up curve, and play rests where the
    last motion left it where that is known.  Effects that the cell has active stay as they are;
    those of a diagnosis are driven as `found`.
    """
    spec = model.cell.model
    active = {p.effect for p in model.parameters}
    if found is not None:
        otherwise = {effect for key, _, _, effect in CHOICES if key not in found.model_keys}
        active |= otherwise & {e.effect for e in found.effects}
    keys = {
        key: value
        for key, value, column, effect in CHOICES
        if recorded(table, column) and effect not in active
    }
    if not keys:
        return model
    cell = replace(model.cell, model=replace(spec, **keys))  # type: ignore[arg-type]
    return Model.assembled(model.chain, cell)


def model_keys(model: Model, found: tuple[FoundEffect, ...]) -> dict[str, str]:
    """Keys of [model] that the effects found rest on."""
    names = {f.effect for f in found}
    spec = model.cell.model
    return {
        key: value
        for key, value, _, effect in CHOICES
        if effect in names and getattr(spec, key) == value
    }
