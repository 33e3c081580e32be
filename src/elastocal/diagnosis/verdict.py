"""What scores mean: the answer by few causes, where the gap lies, everything that was tried."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from elastocal.diagnosis.baseline import (
    NoiseValues,
    NoisyData,
    Projection,
    prior_deviations,
    project,
)
from elastocal.diagnosis.component_answer import DRAWS, NAMED, SumAnswer, held_by_prior
from elastocal.diagnosis.diagnosis import (
    Candidate,
    Curve,
    EffectAt,
    FittedParameter,
    FoundEffect,
    Location,
    NoiseFloor,
    StructureTest,
    Untested,
    Verdict,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic
from elastocal.diagnosis.effect_search import (
    LARGEST_SET,
    ForwardSelection,
    distances,
    fit_extended,
    settings_of,
)
from elastocal.diagnosis.evidence import Grams, Item, Scan, exceedance
from elastocal.diagnosis.hypotheses import CHANGE_TIMES, Hypothesis, times_of
from elastocal.diagnosis.noise_floor import NEW_POSES, mean_square
from elastocal.identification import noise_summary
from elastocal.identification.mistakes import SURELY, TURN_ROUND
from elastocal.identification.solve import FAR, far_off
from elastocal.measurements import told_of_rounding
from elastocal.messages import gathered, listed, rounded
from elastocal.model.effects.base import LinkFrame
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.geometry import KEYS, Backlash
from elastocal.model.effects.statics import JointCompliance
from elastocal.model.manipulator import Model
from elastocal.model.observations import subset
from elastocal.units import Array, BoolArray

SET = 0.95  # probability that the named set holds, as far as so many can
# Two known alternatives at distance d are told apart with probability Φ(d/2) at best: closer than
# this, no evidence can be trusted to name one of them.
TOO_NEAR = 2.0
TOO_NEAR_PROBABILITY = 0.89

# An item and what it may be instead, the likeliest first, with their probabilities.
Rivals = tuple[tuple[Item, float], ...]


def rivals_of(found: ForwardSelection, k: int) -> Rivals:
    """Item k of what the search found and the other effects that it may be."""
    slot, item = found.slots[k], found.chosen.items[k]
    each, nothing = slot.probabilities()
    # That there is something has been decided; now it is only what.
    each = each / (1 - nothing)
    own = next(i for i, other in enumerate(slot.items) if other.what is item.what)
    if not item.known:
        return ((item, float(each[own])),)
    near = distances(found.dataset, found.chosen, k)
    taken = {id(other.what) for other in found.chosen.items}
    same = [
        i
        for i, other in enumerate(slot.items)
        if id(other.what) not in taken and near.get(other.what.key, np.inf) < TOO_NEAR
    ]
    # More than so many are no answer; the others stand among the candidates.
    same = sorted(same, key=lambda i: -each[i])[: LARGEST_SET - 1]
    p = each.copy()
    if same and p[own] > TOO_NEAR_PROBABILITY:
        # Their columns are the same in these poses; what separates the scores is only how many
        # parameters each would need.
        p[same] += (p[own] - TOO_NEAR_PROBABILITY) / len(same)
        p[own] = TOO_NEAR_PROBABILITY
    chosen = [own, *same]
    if p[own] < NAMED:
        # Of the blocks only the likeliest: they all say "something else, about there".
        if blocks := [i for i in range(len(p)) if not slot.items[i].known]:
            likeliest, together = max(blocks, key=lambda i: p[i]), p[blocks].sum()
            p[blocks], p[likeliest] = 0.0, together
        for i in sorted({*range(len(p))} - {*chosen}, key=lambda i: -p[i]):
            if len(chosen) >= LARGEST_SET or p[chosen].sum() >= SET or p[i] < 0.01:
                break
            chosen.append(i)
    chosen = [own, *sorted(chosen[1:], key=lambda i: -p[i])]
    return tuple((slot.items[i], float(p[i])) for i in chosen)


def structure_tests(observed: Scan) -> tuple[StructureTest, ...]:
    """One test per covariate, most telling first; none names an effect.  The statistic is the
    largest evidence among the covariate's blocks; its distribution without structure comes from
    flipping the signs of whole configurations."""
    if not (each := observed.covariates):
        return ()
    odds = {covariate: float(own[0]) for covariate, own in each.items()}
    largest = np.max([own[1:] for own in each.values()], axis=0)
    tests = [
        StructureTest(c, exceedance(own[1:], odds[c]), exceedance(largest, odds[c]))
        for c, own in each.items()
    ]
    return tuple(sorted(tests, key=lambda t: (t.p_family, t.p_value, -odds[t.driver])))


MOST_CURVES = 3

FARTHEST = 10.0  # times what was found that a time constant may be, or part of it


@dataclass(frozen=True)
class FewAnswer(SumAnswer):
    """The pieces of a diagnosis that the few causes fill which the forward search `selected`."""

    selected: ForwardSelection

    @cached_property
    def rivals(self) -> tuple[Rivals, ...]:
        return tuple(rivals_of(self.selected, k) for k in range(len(self.selected.chosen.items)))

    @property
    def verdict(self) -> Verdict:
        if not self.selected.chosen.items:
            return "nothing_significant"
        if self.selected.chosen.unknown:
            return "unknown_effect"
        return "ambiguous" if self.indistinguishable else "explained"

    @property
    def indistinguishable(self) -> tuple[tuple[EffectAt, ...], ...]:
        several = (rivals for rivals in self.rivals if len(rivals) > 1)
        return tuple(tuple(EffectAt(*item.what.key) for item, _ in rivals) for rivals in several)

    @property
    def _named(self) -> list[int]:
        return [k for k, item in enumerate(self.selected.chosen.items) if item.known]

    @property
    def effects(self) -> tuple[FoundEffect, ...]:
        own = ((k, *self.rivals[k][0]) for k in self._named)
        found = tuple(self._found_effect(*item.what.key, [k], p) for k, item, p in own)
        return beside_unknown(found) if self.selected.chosen.unknown else found

    @cached_property
    def _fitted(self) -> Projection:
        """By the weights of an ordinary calibration, as the steps before."""
        return project(self.found.data, self.found.noise.of_instrument())

    @cached_property
    def _refitted(self) -> dict[str, float]:
        """Values by name of the exact model with all items that have a name, fitted to the
        readings, where a geometry is sought: its columns are no line to it."""
        chosen = self.selected.chosen
        named = [chosen.items[k] for k in self._named]
        if not any(self._is_sought(item.what) for item in named):
            return {}
        fitted = fit_extended(self.dataset, chosen, named)
        return dict(zip(fitted.model.names, fitted.x.tolist(), strict=True))

    def _is_sought(self, what: Hypothesis | Generic) -> bool:
        return isinstance(what, Hypothesis) and bool(what.starts(self.dataset.base.model))

    def _error_without(self, gone: Sequence[int]) -> Array:
        return super()._error_without([*gone, *self._unnamed])  # which no cell has that is written

    def _mistimed(self, k: int) -> Array:
        """Mean square (draws,) in m² of new readings, one as soon after any visit as after another,
        between the moment at which item k changes and the one at which it was found to."""
        chosen, every = self.selected.chosen, times_of(self.dataset.visits)
        item, time = chosen.items[k], np.unique(every)
        kinds = [setting.kind for setting in item.what.settings]
        if "change_time" not in kinds or len(time) < 4:
            return np.zeros(DRAWS)
        s = kinds.index("change_time")
        tried, p, _ = self._constants[k][s]
        # Between the two visits at any moment, counted in visits: none are read at night.
        after = np.searchsorted(time, self.rng.choice(tried[:, s], DRAWS, p=p))
        found = np.interp(item.settings[s], time, np.arange(len(time)))
        apart = np.abs(after - self.rng.uniform(size=DRAWS) - found) / (len(time) - 1)
        n_new = NEW_POSES * round(len(every) / len(self.dataset.blocks.member))
        step = mean_square(chosen.data, chosen.signal(k)) / (every > item.settings[s]).mean()
        return np.asarray(self.rng.binomial(n_new, apart) / n_new * step)

    @cached_property
    def _constants(self) -> list[list[tuple[Array, Array, Array]]]:
        """Of every constant of each item: settings (G, …) with it at all values that it may have,
        the others as found, their probabilities (G,), and the item's coefficients (G, width)."""
        chosen = self.selected.chosen
        return [
            [self._tried(k, s) for s in range(len(item.what.settings))]
            for k, item in enumerate(chosen.items)
        ]

    def _tried(self, k: int, s: int) -> tuple[Array, Array, Array]:
        chosen, dataset = self.selected.chosen, self.dataset
        item, data = chosen.items[k], chosen.beside(k)
        assert isinstance(item.what, Hypothesis)
        found, setting = item.settings[s], item.what.settings[s]
        grid = dataset.grids[item.what.key]
        if setting.kind == "change_time":
            values = self.dataset.moments[0]
            values = values[np.argsort(np.abs(values - found))[:CHANGE_TIMES]]
        elif setting.kind == "time_constant":  # as probable from here to twice it as to half of it
            ends = grid.values[:, s]
            values = found * np.geomspace(1 / FARTHEST, FARTHEST, 33)
            values = np.unique(np.clip(values, ends.min(), ends.max()))
        else:
            values = found + grid.step[grid.nearest(item.settings), s] * np.linspace(-1, 1, 33)
            values = np.unique(np.clip(values, setting.lower, setting.upper))
        tried = np.repeat(item.settings[None], len(values), axis=0)
        tried[:, s] = values
        grams = Grams(dataset, data, project(data, chosen.noise))
        evidence = grams.of(item.what, tried).evidence(item.what.scales)
        return tried, special.softmax(evidence), grams.estimates(item.what, tried, chosen.scales[k])

    def _parameters(self, k: int) -> Iterator[FittedParameter]:
        """Of the columns by the instrument's noise or, where a geometry is sought, of the exact
        fit, and one step from there by all the noise."""
        c, span = self.found.components[k], self.found.spans[k]
        assert c.hypothesis is not None
        size = self.dataset.sizes[c.hypothesis.key]
        each = size * [self._fitted.beta[span], self.at.beta[span]]
        D = self.at.beta_deviation[:, span]
        variance, chosen = (D**2).sum(axis=0), self.selected.chosen
        for _, p, estimates in self._constants[k]:  # which are estimated, too
            variance += p @ (estimates - chosen.at.beta[chosen.spans[k]]) ** 2
        std = size * np.sqrt(variance)
        std[held_by_prior(D, self._wide.precision[span])] = np.inf
        for p, first, last, s in zip(c.hypothesis.parameters, *each, std, strict=True):
            name = f"{c.where}.{p.key}"
            value = self._refitted.get(name, p.nominal + float(first))
            yield FittedParameter(name, value + float(last - first), p.unit, float(s))

    components = groups = slight = fields = ()

    @property
    def unexplained(self) -> float:
        return self.supported.unexplained

    @property
    def unnamed_probability(self) -> float:
        """In whichever slot it is likeliest."""
        shares = []
        for slot in self.selected.slots:
            each = slot.probabilities()[0]
            blocks = [p for item, p in zip(slot.items, each, strict=True) if not item.known]
            shares.append(min(float(np.sum(blocks)), 1.0))  # a sum of hundreds may exceed it
        return max(shares)

    def location(self, tests: Sequence[StructureTest]) -> Location | None:
        """Probabilities of stage and place, from all that could stand in the place of the unknown
        effect, or of the first one found."""
        if not (items := self.selected.chosen.items):
            return None
        own = next((k for k, item in enumerate(items) if not item.known), 0)
        slot = self.selected.slots[own]
        each, _ = slot.probabilities()
        each, what = each / max(float(each.sum()), 1e-300), items[own].what
        by_stage, by_place = defaultdict[str, float](float), defaultdict[str, float](float)
        for item, p in zip(slot.items, each.tolist(), strict=True):
            by_stage[item.what.stage] += p
            by_place[item.what.where] += p
        stages, places = (
            {key: p for key, p in one.items() if p > 1e-6} for one in (by_stage, by_place)
        )
        return Location.of(what.stage, what.where, stages, places, tests)

    def curves(self) -> tuple[Curve, ...]:
        """Of the unknown blocks that depend on one number, the largest components first."""
        chosen, present = self.selected.chosen, self.dataset.present
        at, out = chosen.at, list[Curve]()
        for item, span in zip(chosen.items, chosen.spans, strict=True):
            block = item.what
            if isinstance(block, Hypothesis) or block.source is None or block.source.values is None:
                continue
            x, order = np.unique(block.source.values[present], return_index=True)
            direction = block.direction[present]
            motion = direction @ at.beta[span]  # (visits, d)
            deviation = np.linalg.norm(direction @ at.beta_deviation.T[span], axis=2)
            largest = np.argsort(-(motion.std(axis=0) / deviation.mean(axis=0)))
            for k in largest[:MOST_CURVES]:
                alone, y = motion.shape[1] == 1, motion[order, k]
                xyd = (tuple(v.tolist()) for v in (x, y - y.mean(), deviation[order, k]))
                entry = block.where if alone else f"{block.where} {KEYS[k]}"
                unit = "rad" if alone else LinkFrame.units[k]
                out.append(Curve(block.covariate, block.source.unit, entry, unit, *xyd))
        return tuple(out)

    def _named_steps(self) -> Iterator[tuple[str, list[int]]]:
        return ((self.selected.chosen.items[k].what.label, [k]) for k in self._named)


def beside_unknown(effects: Sequence[FoundEffect]) -> tuple[FoundEffect, ...]:
    """Names beside something without a name, which may be part of its imitation."""
    return tuple(replace(f, probability=min(f.probability, TOO_NEAR_PROBABILITY)) for f in effects)


DETECTABLE = 1.0  # standard deviations: below, a typical size does not move the data
STATED_LOW, STATED_HIGH = 0.67, 1.5
FAULTY_SHARE = 0.02
SUSPECT_SHARE = 0.05
OPEN_BACKLASH = 0.2  # probability of the other backlash model from which the reader is told


def candidates(
    dataset: DiagnosisData, few: FewAnswer, told: Sequence[FoundEffect]
) -> tuple[Candidate, ...]:
    """Every hypothesis with its probability, in the slot where it is likeliest, of those `told`
    what is told.  Last come those that the data do not show at typical size and do not ask for:
    they have their prior alone."""
    found, own = few.selected, {(f.effect, f.where): f.probability for f in told}
    best: dict[tuple[str, str], Candidate] = {}
    alone = zip(dataset.hypotheses, found.alone.distance.tolist(), strict=False)
    distance = {h.key: d for h, d in alone}
    for k, slot in enumerate(found.slots):
        rivals = few.rivals[k] if k < len(few.rivals) else ()
        named = {id(item.what): p for item, p in rivals if item.known}
        each, _ = slot.probabilities()
        for item, p, score in zip(slot.items, each, slot.scores, strict=True):
            what = item.what
            if not isinstance(what, Hypothesis):
                continue
            key, p = what.key, own.get(what.key, named.get(id(what), float(p)))
            row = Candidate(*key, what.stage, p, float(score), distance[key], settings_of(item))
            if key not in best or row.probability > best[key].probability:
                best[key] = row
    likeliest = sorted(best.values(), key=lambda c: (-c.probability, -c.score))
    return tuple(sorted(likeliest, key=lambda c: c.detectable < DETECTABLE and c.score <= 0))


def too_small(dataset: DiagnosisData, found: ForwardSelection) -> tuple[Untested, ...]:
    """Hypotheses whose typical size these poses would not show."""
    chosen = {id(item.what) for item in found.chosen.items}
    reason = (
        "at its typical size it does not show in these poses: the fitted parameters follow it, or "
        "it is smaller than the noise"
    )
    loaded = bool(dataset.table.force.any())
    advice = f"spread the poses over more of the work space{', or raise the load' * loaded}"
    if dataset.base.model.observe == "distance":
        advice = "read positions, of which distances to one anchor show less in any pose"
    return tuple(
        Untested(*h.key, reason, advice)
        for h, d in zip(dataset.hypotheses, found.alone.distance, strict=False)
        if d < DETECTABLE and id(h) not in chosen
    )


def warnings(
    dataset: DiagnosisData, found: ForwardSelection, suspects: BoolArray, noise: NoiseFloor
) -> Iterator[str]:
    """What a reader should know before trusting the verdict, by the `noise` that the answer has."""
    data = found.chosen.data
    if data.stated:
        yield from _stated_wrong(dataset, data, noise)
    turning = dataset.base.model.chain.turning
    scatter = np.array(noise.repeatability)[turning]
    if told := told_of_rounding(dataset.table, turning, scatter):
        yield told[0].lower() + told[1:].removesuffix(".")
    if (faulty := data.faulty.mean()) > FAULTY_SHARE:
        yield (
            f"{100 * faulty:.0f} % of the readings disagree with all others and were excluded; "
            "look for the cause before trusting the rest"
        )
    kept = np.flatnonzero(suspects)
    if len(kept) > SUSPECT_SHARE * len(suspects):
        lines = dataset.table.row[dataset.lead[kept]]
        yield (
            f"{len(kept)} of {len(suspects)} readings (lines {lines.min()} to "
            f"{lines.max()}) lie far beyond the scatter of the others, too many or too near each "
            "other to be accidents; they were kept: look at them with `elastocal identify` first"
        )
    named = [i.what.where for i in found.chosen.items if isinstance(i.what, Hypothesis)
             and i.what.name == Backlash.name]  # fmt: skip
    if named and found.dataset.other_backlash > OPEN_BACKLASH:
        places = " and ".join(named)
        yield (
            f"hardly any reading shows whether the play of {places} follows the load alone or also "
            "the last motion, so the error left at new poses is uncertain: measure poses in which "
            f"the load hardly turns {places}, approached from both sides"
        )
    if dataset.table.time is None:
        yield "without times no drift can be seen, and a jump only by the order of the rows"


def turned_loads(dataset: DiagnosisData, noise: NoiseValues) -> Iterator[str]:
    """Where most compliances of the fitted model are surely negative, as `impossible_values`."""
    base, fitted = dataset.base, dataset.fitted
    of = {
        p.name: j for j, p in enumerate(base.model.parameters) if p.effect == JointCompliance.name
    }
    k = [i for i, name in enumerate(fitted) if name in of and base.x[of[name]] < 0]
    if 2 * len(k) <= len(of) or not dataset.table.force.any():
        return
    at = np.array([of[fitted[i]] for i in k])
    deviation = np.linalg.norm(project(dataset.data, noise).beta_deviation[:, k], axis=0)
    surely = at[base.x[at] < -SURELY * prior_deviations(base)[at] * deviation]
    if 2 * len(surely) > len(of):
        names = gathered(base.model.names[j] for j in surely)
        yield f"{names} negative, which no spring is: do not use this model. {TURN_ROUND}"


def unheard_of(found: Sequence[FoundEffect], model: Model) -> dict[str, tuple[str, float]]:
    """Parameters of causes whose whole interval lies more than FAR typical deviations from nominal,
    by name: the effect, and by how many times it is larger than usual."""
    far = dict[str, tuple[str, float]]()
    for f in found:
        specs = effect_of(f.effect).parameters(f.where, model.chain, model.cell)
        known = {f"{f.where}.{p.key}": p for p in specs if not p.shrunk}
        for v in (v for v in f.parameters if v.name in known):
            p, half = known[v.name], special.ndtri(0.975) * v.std
            if times := far_off(v.value - p.nominal, half, p.typical):
                far[v.name] = f.effect, times
    return far


def confirm(far: Mapping[str, tuple[str, float]]) -> Iterator[str]:
    if far:
        each = [f"{name} ({rounded(times, 2)} times)" for name, (_, times) in far.items()]
        yield (
            f"more than {FAR:g} times as large as usual: {listed(each)}; confirm such a cause at "
            "the arm before you rely on its name, as what the catalogue lacks may look like it"
        )


def _stated_wrong(dataset: DiagnosisData, data: NoisyData, noise: NoiseFloor) -> Iterator[str]:
    """Where the tracker's noise is beyond what chance makes of the stated one, and repeats or
    markers of one pose, where they tell, say so too; or what is stated is far too large, where
    nothing tells the tracker from the joints for both together."""
    base, good, dof = dataset.base, ~data.faulty, max(data.n_rows - data.X.shape[2], 1)
    readings = subset(base.observed, good), base.residual.reshape(len(good), -1)[good].ravel()
    common = noise_summary.less_in_common(*readings, base.model.cell, len(base.x))
    if common is not None:
        yield noise_summary.TOO_LARGE_IN_COMMON.format(common)
        return
    assert base.stated is not None
    single = noise_summary.single_readings(*readings, base.stated[good], len(base.x))
    factor = noise.stated_factor
    wrong = (noise.ratio_to_stated if single is None else factor) < STATED_LOW
    if factor**2 * dof >= special.chdtri(dof, noise_summary.BEYOND):
        positions = base.observed.kind == "position"
        wrong = single is None or single.above if positions else factor > STATED_HIGH
    if wrong:
        yield (
            f"the readings scatter {rounded(factor, 2)} times as much as cell or table state; "
            "correct [tracker], the stated noise"
        )
