"""What might be missing from the model: every effect at every place where it could act."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.cell import Cell, EffectChoice
from elastocal.diagnosis.result import Untested
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.effects import CATALOGUE
from elastocal.manipulator.effects.base import Effect, Stage
from elastocal.manipulator.effects.driven import DrivenEffect
from elastocal.manipulator.model import Model
from elastocal.manipulator.parameter import ParameterSpec, Setting
from elastocal.measurements import Measurements

# What each need of an effect asks the user to record.
RECORD = {
    "time": ("the table has no time column", "record time_s or time_min of every reading"),
    "approach": (
        "the table does not say from which side each joint came to rest",
        "record approach_1 … (+1 or -1), and visit some poses from both sides",
    ),
    "temperature": ("the table has no temperature column", "record temperature_C"),
    "load": (
        "no reading is loaded, and the model has no weights",
        "measure some poses with and without a load, or give the links' masses and set "
        "[model] link_gravity = true",
    ),
}


@dataclass(frozen=True)
class Hypothesis:
    """One effect at one place that the model does not have."""

    effect: Effect
    where: str
    parameters: tuple[ParameterSpec, ...]
    settings: tuple[Setting, ...]

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def stage(self) -> Stage:
        return self.effect.stage

    @property
    def label(self) -> str:
        return f"{self.name} at {self.where}"

    @property
    def choice(self) -> EffectChoice:
        return EffectChoice(self.name, self.where)


def possible(
    model: Model, table: Measurements, without: tuple[str, ...] = ()
) -> tuple[list[Hypothesis], list[Untested]]:
    """Hypotheses that the table's columns can test, and the effects it cannot, with advice."""
    chain, cell = model.chain, model.cell
    active = {(p.effect, p.where) for p in model.parameters}
    hypotheses: list[Hypothesis] = []
    untested: list[Untested] = []
    for name, effect in CATALOGUE.items():
        if name in without or not effect.may_be_missing(cell):
            continue
        places = [w for w in effect.places(chain, cell) if (name, w) not in active]
        at = [_at(effect, w, chain, cell) for w in places]
        lacking = [need for need in _needed(at, effect, cell) if not recorded(table, need)]
        if lacking:
            reason, advice = RECORD[lacking[0]]
            untested += [Untested(name, w, reason, advice) for w in places]
            continue
        for h in at:
            if key := _unset(h, chain, cell):
                reason = f"{key} is not known, and only settings of a driven effect are searched"
                advice = f"state {key} in [model.nominal.settings.{h.where}]"
                untested.append(Untested(name, h.where, reason, advice))
            else:
                hypotheses.append(h)
    return [h for h in hypotheses if h.parameters], untested


def recorded(table: Measurements, need: str) -> bool:
    """Whether the table says what an effect needs, with more than one value of it."""
    if need == "load":
        return bool(np.any(table.force != 0))
    values = getattr(table, need)
    return values is not None and bool(np.any(values != values[:1]))


def _at(effect: Effect, where: str, chain: Chain, cell: Cell) -> Hypothesis:
    """Only a drive can be evaluated at many settings; those of other effects stay as the model
    has them."""
    parameters = effect.parameters(where, chain, cell)
    searched = isinstance(effect, DrivenEffect)
    settings = effect.settings(where, chain, cell) if searched else ()
    return Hypothesis(effect, where, parameters, settings)


def _unset(h: Hypothesis, chain: Chain, cell: Cell) -> str | None:
    """A setting that is neither searched nor stated."""
    given = cell.model.nominal.settings.get(h.where, {})
    held = () if h.settings else h.effect.settings(h.where, chain, cell)
    return next((s.key for s in held if s.default is None and s.key not in given), None)


def _needed(at: list[Hypothesis], effect: Effect, cell: Cell) -> tuple[str, ...]:
    """What the effect needs, times included where it has settings that are times."""
    kinds = {setting.kind for hypothesis in at for setting in hypothesis.settings}
    timed = ("time",) if kinds & {"change_time", "time_constant"} else ()
    return tuple(dict.fromkeys((*effect.needed(cell), *timed)))
