"""What can be fitted, as rows: each effect of the catalogue with its unit, size, places, words."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.model.arm import ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.choice import cell_of, load_chain
from elastocal.model.effects import CATALOGUE
from elastocal.model.effects.base import Effect
from elastocal.report.effect_names import STAGES, places
from elastocal.report.formatting import display


def effect_entries(cell: Cell | str | Path) -> list[dict[str, Any]]:
    """Per effect, in the catalogue's order: name, stage, what it is, places, parameters.

    Places and sizes are those of the cell's arm.  An effect that the cell fits is `on`.  A
    parameter's typical size is null where only the readings say it.
    """
    given = cell_of(cell)
    chain = load_chain(given)
    on = {choice.name for choice in given.model.effects}
    return [_entry(effect, chain, given, effect.name in on) for effect in CATALOGUE.values()]


def _entry(effect: Effect, chain: Chain, cell: Cell, on: bool) -> dict[str, Any]:
    where = effect.places(chain, cell)
    parameters = _parameters(effect, where, chain, cell)
    return {
        "name": effect.name,
        "stage": effect.stage,
        "on": on or effect.acts_unasked(cell),
        "what": what_it_is(effect),
        "places": list(where),
        "needs": list(effect.needed(cell)),
        "parameters": [
            {"key": p.key, "unit": p.unit, "nominal": p.nominal, "typical": p.typical}
            for p in parameters
        ],
    }


def _parameters(
    effect: Effect, where: tuple[str, ...], chain: Chain, cell: Cell
) -> tuple[ParameterSpec, ...]:
    """Those at its first place; none where settings of the cell make them."""
    try:
        return effect.parameters(where[0], chain, cell) if where else ()
    except InputError:  # link weights without masses
        return ()


def what_it_is(effect: Effect) -> str:
    """The first paragraph of the effect's own text, on one line."""
    first = inspect.cleandoc(type(effect).__doc__ or "").split("\n\n")[0]
    return " ".join(first.split())


def effect_lines(entries: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """For people, in order: stage, name with places and sizes (* where it is on), what it is."""
    return [
        (
            STAGES[entry["stage"]],
            f"{entry['name']}{' *' if entry['on'] else ''}: "
            f"{places(entry['places'], runs=True) or 'nowhere here'}; "
            f"{_sizes(entry['parameters'])}",
            entry["what"],
        )
        for entry in entries
    ]


def _sizes(parameters: list[dict[str, Any]]) -> str:
    """The typical sizes in each unit: "3 mm, 3 mrad", "0.004 to 0.1 mrad"."""
    sizes: dict[str, list[float]] = {}
    for p in parameters:
        value, unit = display(p["typical"] or 0.0, p["unit"])
        sizes.setdefault(unit, []).append(float(f"{value:.2g}"))
    told = []
    for unit, found in sizes.items():
        ends = dict.fromkeys(f"{v:g}" for v in (min(found), max(found)))
        told.append(f"{' to '.join(ends)} {unit}" if max(found) else f"{unit}, as the readings say")
    return ", ".join(told) or "no size of its own"
