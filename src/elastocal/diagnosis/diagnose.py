"""Why the arm still differs from its model: the diagnosis step by step, and the cell it extends."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from elastocal.cell import Cell, read_cell
from elastocal.config import MAX_BYTES, folded, rewritten_toml
from elastocal.diagnosis.baseline import Baseline, NoiseValues, fit_baseline, thinned
from elastocal.diagnosis.component_answer import PAYS, SumAnswer
from elastocal.diagnosis.component_search import (
    CLEARLY,
    Growth,
    compared_score,
    hidden_fellows,
    search_components,
    sum_of,
)
from elastocal.diagnosis.diagnosis import SMALLEST_P, Diagnosis, FoundEffect, Gap, StructureTest
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of, generic_blocks
from elastocal.diagnosis.effect_search import MANY, ForwardSelection, with_likelier_backlash_model
from elastocal.diagnosis.hypotheses import (
    BY_LAST_MOVE,
    OUT_OF_ORDER,
    Hypothesis,
    corrects,
    model_keys,
    possible,
    with_recorded_drivers,
)
from elastocal.diagnosis.noise_floor import FALSE_SMOOTH, first_steps, screen_outliers
from elastocal.diagnosis.verdict import (
    FewAnswer,
    beside_unknown,
    candidates,
    confirm,
    structure_tests,
    too_small,
    turned_loads,
    unheard_of,
    warnings,
)
from elastocal.files import atomic_writer, is_plugin_file, read_text
from elastocal.identification.faulty_readings import FaultyGroup
from elastocal.identification.identify import misread_for_a_while
from elastocal.identification.mistakes import POOREST, length_of, likely_mistake, refuse_nonsense
from elastocal.identification.outliers import FALSE_ALARM, FEW, find_faulty, named_runs
from elastocal.identification.scrutiny import BudgetStep, autocorrelation
from elastocal.identification.start import (
    check_table,
    fallen,
    solved_body,
    turned_base,
    without_copies,
)
from elastocal.measurements import Measurements, order_contradicted, past_midnight
from elastocal.messages import (
    ElastocalError,
    InputError,
    InsufficientDataError,
    counted,
    did_you_mean,
    length,
    listed,
    option,
    require,
)
from elastocal.model.effects.catalogue import CATALOGUE, effect_of
from elastocal.model.manipulator import Model, where_smooth_functions_end
from elastocal.model.observations import subset
from elastocal.units import BoolArray, Progress

# Keys of the cell file, in whatever table, whose texts are paths.
PATHS = ("urdf", "mjcf", "dh", "masses", "file", "candidates")


def write_extended_cell(
    source: str | Path,
    target: str | Path,
    found: Sequence[FoundEffect],
    model_keys: Mapping[str, str] | None = None,
    keys: Mapping[str, Any] | None = None,
) -> Cell:
    """Write the cell file `source` to `target` with the effects `found` switched on; read it back.

    Each effect joins `[model] effects` as "effect:where", its searched constants join
    `[model.nominal.settings]`, the sizes of its parameters, where they were estimated,
    `[model.nominal.sizes]`.  Relative paths are rewritten so that they lead from `target`'s folder
    to the same files; a cell without a name keeps the one that its old file gave it.
    `model_keys` join [model] as they are; with `keys`, which join the whole file by table, nothing
    is left to be chosen for a plan.  Lines that say the same stay as they are written.

    Raises InputError where `source` is no valid cell file or `target` cannot be written."""
    source, target = Path(source), Path(target)
    name = read_cell(source).name
    # The real folders: ".." of a link to a folder is not where the link stands.
    folders = source.parent, os.path.realpath(target.parent)

    def change(data: Any) -> None:
        data.setdefault("name", name)
        _redirect(data, *folders)
        model = data.setdefault("model", {}) if found else {}
        for f in found:
            effects = model.setdefault("effects", [])
            if (entry := f"{f.effect}:{f.where}") not in effects:
                effects.append(entry)
            values = {p.name.removeprefix(f"{f.where}."): p.value for p in f.parameters}
            if hints := effect_of(f.effect).hints(f.where, values):
                model.setdefault("nominal", {}).update(hints)
            for key, found_there in (("settings", f.settings), ("sizes", f.sizes)):
                if found_there:
                    _join(model, {"nominal": {key: {f.where: found_there}}})
        folded(model.get("effects"))
        model.update(model_keys or {})
        if keys:
            data.get("design", {}).pop("choose", None)
            _join(data, keys)

    text = re.sub(ENDS.format(".*"), "", read_text(source, "cell file", MAX_BYTES))
    text = rewritten_toml(text, change)
    with atomic_writer(target) as handle:
        handle.write(text)
        handle.flush()
        # Read before it appears: a cell that cannot be read is not left behind.
        written = replace(read_cell(handle.name), path=target)
        if ends := where_smooth_functions_end(written):
            handle.seek(0)
            handle.write(ENDS.format(ends) + text)
        return written


ENDS = """\
# Smooth functions correct the arm where it was measured, {};
# beyond, the model without them holds.
"""


def _join(data: dict[str, Any], keys: Mapping[str, Any]) -> None:
    for name, value in keys.items():
        if isinstance(value, Mapping):
            _join(data.setdefault(name, {}), value)
        else:
            data[name] = value


def _redirect(there: Any, old: Path, new: str, key: str = "") -> None:
    """Paths in a table or list lead from the folder `new` to the files that they led to from
    `old`."""
    for at, value in list(there.items() if isinstance(there, dict) else enumerate(there)):
        name = at if isinstance(there, dict) else key
        of_file = name in PATHS or (name == "modules" and is_plugin_file(str(value)))
        if isinstance(value, dict | list):
            _redirect(value, old, new, name)
        elif of_file and isinstance(value, str) and not os.path.isabs(value):
            there[at] = Path(os.path.relpath(os.path.realpath(old / value), new)).as_posix()


@dataclass(frozen=True)
class DiagnosisOptions:
    """How to diagnose.

    `false_alarm`: probability that something is claimed where nothing is, for the whole family of
    hypotheses.  `without`: effects taken out of the catalogue.  `seed`: of the sign flips and of
    the draws behind intervals."""

    seed: int = 0
    without: tuple[str, ...] = ()
    false_alarm: float = 0.05

    def __post_init__(self) -> None:
        require(
            0 < self.false_alarm < 0.5,
            f"{option('false_alarm')} takes a number between 0 and 0.5; found {self.false_alarm:g}",
        )
        for name in self.without:
            if name not in CATALOGUE:
                raise InputError(
                    f"{option('without')}: unknown effect '{name}'"
                    f"{did_you_mean(name, list(CATALOGUE))}; "
                    f"the catalogue has: {listed(list(CATALOGUE))}"
                )


FEWEST = 8  # configurations


def diagnose(
    model: Model,
    table: Measurements,
    options: DiagnosisOptions | None = None,
    progress: Progress = lambda message: None,
) -> Diagnosis:
    """Where the gap between model and measurement lies, what causes it, how far it shrinks.

    The cell's effects are fitted; noise floor and faulty readings come first; every effect of the
    catalogue at every place, and smooth dependences without a name, are then judged by their
    marginal likelihood; what is claimed has to beat the whole family under sign flips.

    Raises InputError for data that contradict robot or cell, InsufficientDataError where there
    are too few configurations to tell an effect from noise."""
    options = options or DiagnosisOptions()
    found = _diagnosed(model, table, options, progress)
    assert found.calibrated is not None
    lies = fallen(found.calibrated.model, found.calibrated.x)
    if lies is None or model.observe == "distance":
        return found
    if lies.axis is None:
        return replace(found, warnings=(str(lies), *found.warnings))
    progress(f"once more with {lies.axis} up")
    upright = _diagnosed(model, lies.turned(table), options, progress)
    before, after = (d.budget[-2].heldout_rms for d in (found, upright))
    names = listed(f"{f.effect}:{f.where}" for f in upright.effects) or "none"
    told = (
        f"{lies}. With {lies.axis} up the verdict is {upright.verdict} (effects: {names}), and the "
        f"held-out error falls to {length(after)} instead of {length(before)}"
    )
    if after > (1 - PAYS) * before:
        told = f"{lies}. Here it makes no difference"
    return replace(found, warnings=(told, *found.warnings))


def _diagnosed(
    model: Model, table: Measurements, options: DiagnosisOptions, progress: Progress
) -> Diagnosis:
    base, left, told = _fitted(model, table, options.seed, progress)
    if disordered := order_contradicted(left):
        told.append(disordered + OUT_OF_ORDER)
        options = replace(options, without=(*options.without, *BY_LAST_MOVE))
    hypotheses, untested = possible(base.model, left, options.without)
    progress("columns of what could be missing")
    dataset = with_likelier_backlash_model(diagnosis_data_of(base, hypotheses))
    base = dataset.base
    few, suspects = _few_causes(dataset, options, progress)
    dataset, found = few.before, few.selected
    whole, nats, fields = _sum_of_all(few, options, progress)
    progress("confirming")
    turned = turned_base(base.model, base.observed, base.residual)
    tests, answer = structure_tests(found.first), whole or few
    answers = _pieces(answer, dataset, found.nothing.noise, tests, fields)
    added = (*answers["effects"], *answers["slight"])
    there = () if whole is None else {(f.effect, f.where) for f in added}
    small = [u for u in too_small(dataset, found) if (u.effect, u.where) not in there]
    p, nothing = found.p_value, found.slots[0].probabilities()[1]
    if nats > 0:
        # Of a sum that is so many nats more probable than nothing, noise alone yields as much with
        # a chance of exp(−nats) at most (Markov's inequality).
        p, nothing = max(min(p, math.exp(-nats)), SMALLEST_P), min(nothing, float(expit(-nats)))
    if answers["gap"].open:
        # What is left is no noise, whatever it is.
        nothing = min(nothing, FALSE_SMOOTH)
    return Diagnosis(
        **answers,
        candidates=candidates(dataset, few, () if answers["groups"] else answers["effects"]),
        structure=tests,
        probability_nothing=nothing,
        p_value=p,
        untested=(*untested, *small),
        warnings=(
            *told,
            *turned_loads(dataset, found.nothing.noise),
            *filter(None, [solved_body(left, float(base.residual.std())), turned]),
            *warnings(dataset, found, suspects, answers["noise"]),
            *confirm(unheard_of(answers["effects"], base.model)),
        ),
        n_readings=dataset.blocks.n,
        n_configurations=len(dataset.blocks.member),
        model_keys=model_keys(base.model, added),
        model=model,
        data=table.source,
        calibrated=base,
    )


def _fitted(
    model: Model, table: Measurements, seed: int, progress: Progress
) -> tuple[Baseline, Measurements, list[str]]:
    """The model as it is, the readings that it is fitted to, and why others are left out."""
    check_table(model, table, likely_mistake)
    if (n := len(np.unique(table.configuration))) < FEWEST:
        raise InsufficientDataError(
            f"{table.source}: {n} configurations are too few to tell a missing effect from noise; "
            f"measure {FEWEST} at least, better 30 or more"
        )
    table, copies = without_copies(table)
    told = [*copies, *past_midnight(table)]
    table, left_out = thinned(table)
    model = with_recorded_drivers(model, table)
    progress("fitting the model as it is")
    base = fit_baseline(model, table, seed)
    if blocks := _misread(base, table, seed):
        gone = np.isin(table.row, np.concatenate([g.lines for g in blocks]))
        told.append(MISREAD.format(listed(map(str, blocks), 4), int(gone.sum()), len(gone)))
        table = table.take(~gone)
        base = fit_baseline(model, table, seed)
    if lines := _far_off(base, table, seed):
        told.append(FAR_OFF.format(counted(len(lines), "reading"), listed(named_runs(lines), 8)))
        table = table.take(~np.isin(table.row, lines))
        base = fit_baseline(model, table, seed)
    return base, table, [*told, *filter(None, [left_out])]


# What stands for a while and goes again has no effect of the catalogue; what stays has.
MISREAD = (
    "one common shift explains {0}: {1} of {2} readings were left out, as by identify; look for "
    "what moved there, a marker or the instrument"
)
FAR_OFF = "{} left out, as by identify, since no arm could be there: check lines {} of the table"


def _misread(base: Baseline, table: Measurements, seed: int) -> list[FaultyGroup]:
    """A block that one shift explains leaves residuals that follow each other alike.  A few faulty
    readings are accidents, and screened; of more `identify` is asked."""
    alike = autocorrelation(base.residual, base.observed)
    if alike is None or alike.p >= FALSE_ALARM or base.problem is None:
        return []
    with suppress(ElastocalError):  # what does not determine an arm names no block
        if find_faulty(base.problem, base.x).mean() > FEW:
            return misread_for_a_while(base.model, table, seed)
    return []


def _far_off(base: Baseline, table: Measurements, seed: int) -> list[int]:
    """Lines of readings that no arm could give: beside some that are metres off nothing fits, and
    as in `identify` they go first.  Raises InsufficientDataError where nothing fits without them.
    """
    model = base.model
    try:
        refuse_nonsense(model, base.observed, base.x, base.residual, table)
    except InsufficientDataError:
        if base.problem is None or not (wrong := find_faulty(base.problem, base.x)).any():
            raise
        apart = subset(base.observed, wrong)
        first = base.observed.table.row[base.observed.lead[wrong]]
        sound = fit_baseline(model, table.take(~np.isin(table.row, first)), seed)
        refuse_nonsense(model, sound.observed, sound.x, sound.residual, table, apart)
        off = apart.value - model.predict(apart.table, sound.x, apart)
        far = np.linalg.norm(off.reshape(len(first), -1)[:, :3], axis=1)
        return first[far > POOREST * length_of(model, table)].tolist()
    return []


def _sum_of_all(
    few: FewAnswer, options: DiagnosisOptions, progress: Progress
) -> tuple[SumAnswer | None, float, tuple[FoundEffect, ...]]:
    """The sum of all that may act at once, None where a few causes are the better answer, by how
    many nats it is more probable than nothing, and what has no name in it."""
    progress("judging all that may act at once")
    found = few.selected
    chosen, nothing = found.chosen, found.nothing.score
    open_ = few.verdict == "unknown_effect" or few.supported.open

    def summed(dataset: DiagnosisData, without: set[str]) -> tuple[SumAnswer, float, Growth] | None:
        if (searched := search_components(dataset, chosen, open_, without, progress)) is None:
            return None
        growth, total = searched
        hidden = hidden_fellows(total, growth.others)
        answer = SumAnswer(few.before, growth.dataset, total, hidden, few.rng, {}).decided
        return answer, compared_score(growth.dataset, total) - nothing, growth

    if (searched := summed(few.before, {*options.without})) is None:
        return None, 0.0, ()
    answer, over, growth = searched
    n_causes = len({(c.family, c.where) for c in answer.found.components})
    if over > CLEARLY + max(chosen.score - nothing, 0.0) and n_causes >= MANY:
        # What would have to be larger than on any arm has to be missed where it does not exist.
        far = unheard_of(answer.effects, few.before.base.model)
        kinds = dict.fromkeys(kind for kind, _ in far.values())
        instead = {kind: growth.instead_of(kind, answer.found) for kind in kinds}
        return replace(answer, instead=instead) if instead else answer, over, ()
    causes = {name for name, effect in CATALOGUE.items() if not corrects(effect)}
    known = [item.what for item in chosen.items if isinstance(item.what, Hypothesis)]
    named = {(c.effect.name, c.where) for c in answer.found.components if c.effect.name in causes}
    if open_ and not named <= {h.key for h in known}:
        # Names that the verdict does not know stand for what is unknown: searched without them.
        bare = replace(few.before, hypotheses=tuple(known))
        if (searched := summed(bare, {*options.without, *causes})) is not None:
            answer = searched[0]
    # Curves, lines and what has no name correct the arm though the verdict knows no cause of them.
    correcting = (f for f in answer.effects if corrects(effect_of(f.effect)))
    return None, 0.0, (*correcting, *answer.fields)


def _pieces(
    answer: SumAnswer, before: DiagnosisData, noise: NoiseValues, tests: tuple[StructureTest, ...],
    corrections: tuple[FoundEffect, ...],
) -> dict[str, Any]:  # fmt: skip
    """What an answer fills of a diagnosis; `before` and its `noise` without further effects, and
    what corrects the arm where it has no name of its own for it."""
    first = first_steps(before, noise, answer.rng)
    steps = answer.budget(first)
    named = [step for step in steps if not step.step.startswith("unknown")]
    floor = answer.supported.noise
    gap = Gap(
        steps[0].heldout_rms, first[-1].heldout_rms, named[-1].heldout_rms, floor,
        answer.unexplained, answer.supported.stands_out,
    )  # fmt: skip
    location = answer.location(tests)
    if location is None and gap.open:
        location = answer.supported.location(tests)
    unknown = answer.verdict == "unknown_effect"
    return {
        "verdict": "unknown_effect" if gap.open else answer.verdict,
        "gap": gap,
        "budget": (*steps, BudgetStep("noise_floor", floor, (floor, floor))),
        "effects": beside_unknown(answer.effects) if gap.open else answer.effects,
        "indistinguishable": answer.indistinguishable,
        "location": location,
        "noise": answer.supported.told,
        "probability_unknown": max(answer.unnamed_probability, gap.open * (1 - FALSE_SMOOTH)),
        "curves": answer.curves(),
        "components": answer.components,
        "groups": answer.groups,
        # Beside few causes that explain it all, corrections without a name are not needed.
        "fields": (corrections or answer.fields) if gap.open or unknown or answer.groups else (),
        "slight": answer.slight,
    }


NEXT_TO_NOTHING = 0.1


def _few_causes(
    dataset: DiagnosisData, options: DiagnosisOptions, progress: Progress
) -> tuple[FewAnswer, BoolArray]:
    """The answer by few causes, and suspects (N,) that stay.  What may be of any size is believed
    to be where it leaves next to nothing open, nor needs more."""
    usual = few, _ = _searched(dataset, options, progress)
    if not few.selected.first.large:
        return usual
    wide = large, _ = _searched(few.before.of_any_size, options, progress)
    left, before = (answer.supported.unexplained for answer in (large, few))
    known = large.verdict != "unknown_effect" and large.selected.chosen.items
    closed = not large.supported.open or left < NEXT_TO_NOTHING * before
    few_enough = known and len(known) <= max(len(few.selected.chosen.items), 1)
    return wide if closed and few_enough else usual


def _searched(
    dataset: DiagnosisData, options: DiagnosisOptions, progress: Progress
) -> tuple[FewAnswer, BoolArray]:
    """What is missing in the data without the faulty readings, which are sought twice, since beside
    a large effect nothing looks faulty, or the wrong readings do, and suspects (N,) that stay."""

    def search_without(faulty: BoolArray) -> ForwardSelection:
        good = dataset.without(faulty)
        return ForwardSelection(good, generic_blocks(good), options.false_alarm, options.seed)

    progress("noise floor")
    faulty, suspects = screen_outliers(dataset, dataset.data)
    progress("searching for what is missing")
    found = search_without(faulty)
    if found.chosen.items:
        before, every = faulty, found.chosen.data.without(np.zeros_like(faulty))
        faulty, suspects = screen_outliers(found.dataset, every)
        if (faulty != before).any():
            progress("searching again without outliers")
            found = search_without(faulty)
    total, rng = sum_of(found.dataset, found.chosen), np.random.default_rng(options.seed)
    few = FewAnswer(dataset.without(faulty), found.dataset, total, (), rng, {}, found)
    return few, suspects
