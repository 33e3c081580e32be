"""What a diagnosis says: verdict, effects, candidates, location, budget; also as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from elastocal.above import Result
from elastocal.diagnosis.baseline import Baseline
from elastocal.identification.result import Finding
from elastocal.identification.scrutiny import BudgetStep
from elastocal.measurements import Measurements
from elastocal.messages import SMALLEST_P as SMALLEST_P
from elastocal.messages import option, plain
from elastocal.model.effects.base import Stage
from elastocal.model.manipulator import Model


@dataclass(frozen=True)
class RivalPair:
    """Two hypotheses and how far apart they are: d in standard deviations of the noise, in the
    data so far and with the extra poses, each the smaller of the two ways round.

    The best possible test between two known alternatives is right with probability Φ(d/2)."""

    first: str
    second: str
    distance_before: float
    distance_after: float


@dataclass(frozen=True)
class ExtraPlan:
    """Extra poses that tell the rivals apart, or why none would.

    `plan` holds one row per visit (pose and load state) in the order of measuring, None where
    poses cannot separate them; `probability_before` and `probability_after` of naming the right
    one of the rivals; `probability_random` the same after as many random poses.  Rivals that no
    pose separates count as one: `inseparable`, groups of their names.  `advice` in words (load,
    approach direction, time, monuments)."""

    separable: bool
    inseparable: tuple[tuple[str, ...], ...]
    n_poses: int
    rivals: tuple[str, ...]
    pairs: tuple[RivalPair, ...]
    plan: Measurements | None
    probability_before: float
    probability_after: float
    probability_random: float
    advice: tuple[str, ...]


Verdict = Literal["explained", "nothing_significant", "unknown_effect", "ambiguous"]
Interval = tuple[float, float]
MICRO = 1e6

# A true effect at this distance (standard deviations) from "nothing" is found 99 times in 100,
# Φ(5/2); at less than FAINTEST it is missed more often than not once the search is paid for.
VISIBLE, FAINTEST = 5.0, 3.0
LARGE = 0.1  # share of the gap, in squares, from which what has no name leaves the verdict open
STRUCTURE = 0.05  # family-wise p-value up to which the dependence on a covariate is told


@dataclass(frozen=True)
class EffectAt:
    """An effect at a place, e.g. gear_eccentricity at joint2."""

    effect: str
    where: str


@dataclass(frozen=True)
class FittedParameter:
    """A parameter of an added effect, in `unit` (SI); `std` is infinite where the data determine
    only what it does together with others, and the value is one of many that do the same."""

    name: str
    value: float
    unit: str
    std: float


@dataclass(frozen=True)
class FoundEffect:
    """An effect held to be real (or, where the verdict is ambiguous, the likeliest of a set).

    `probability` that it is this effect at this place.  `gap_reduction` is the fraction by which
    the 3-D error of noise-free new poses falls when the effect joins all others in the model, with
    90 and 95 % intervals.  `settings` are its searched constants (orders, times) by their keys,
    `sizes` the typical deviations of its parameters from nominal by theirs, where estimated."""

    effect: str
    where: str
    probability: float
    gap_reduction: float
    gap_reduction_ci90: Interval
    gap_reduction_ci95: Interval
    parameters: tuple[FittedParameter, ...]
    settings: dict[str, float]
    sizes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ComponentShare:
    """What errors of one kind at one place contribute to the gap, all components judged together.

    `family` says what the error depends on: "angle" (the joint's own), "gravity", "torque",
    "load", "move" (the last one), "time", "temperature", "pose", "tool".  `share` is that of the
    squared gap after geometry which goes when it is added last, with its 90 % interval.  `rms` in
    m, with its 95 % interval.  `probability` that it is there and moves the markers by a hundredth
    of the gap's rms or more; `named` where some effect of the catalogue is in it."""

    family: str
    where: str
    effects: tuple[str, ...]
    share: float
    share_ci90: Interval
    rms: float
    rms_ci95: Interval
    probability: float
    named: bool


@dataclass(frozen=True)
class EffectGroup:
    """One finding: an effect at all the places where it acts, with its share of the gap and the
    fraction by which the error of new poses falls when it is added to all the others.

    `name` is the effect's, or "gear_errors" for all that goes with a joint's own angle."""

    name: str
    places: tuple[str, ...]
    effects: tuple[str, ...]
    share: float
    share_ci90: Interval
    gap_reduction: float
    gap_reduction_ci90: Interval


@dataclass(frozen=True)
class Candidate:
    """A hypothesis that was tried.

    `score` is the log of its marginal likelihood over that of no further effect (nats);
    `detectable` the distance d, in standard deviations, that its typical size moves the data
    once the fitted parameters have followed: below about 3 these data could not show it."""

    effect: str
    where: str
    stage: Stage
    probability: float
    score: float
    detectable: float
    settings: dict[str, float]

    @property
    def seen_from(self) -> float:
        """The size, in typical sizes, from which it would have been seen."""
        return VISIBLE / self.detectable if self.detectable > 0 else math.inf

    @property
    def visible(self) -> bool:
        """Whether it would have shown at its typical size."""
        return self.detectable >= VISIBLE

    @property
    def hidden(self) -> bool:
        """Whether it hides in the noise at its typical size."""
        return self.detectable < FAINTEST


@dataclass(frozen=True)
class Untested:
    """An effect the data cannot test, why, and what to record or measure so that they can."""

    effect: str
    where: str
    reason: str
    advice: str


@dataclass(frozen=True)
class Gap:
    """3-D rms marker errors in m on held-out poses; the noise floor is what noise alone gives.

    `unexplained` is scatter that fits as if it were noise, and is none: repeats do not show it,
    neighbours in pose or time share it, or joints would have to be worse than joints are.
    `joint_stands_out`: one scatters more than the others let expect."""

    nominal: float
    calibrated: float
    explained: float
    noise_floor: float
    unexplained: float = 0.0
    joint_stands_out: bool = False

    @property
    def unexplained_share(self) -> float:
        """Of the calibrated arm's excess over the noise, in squares."""
        excess = max(self.calibrated**2 - self.noise_floor**2, self.unexplained**2)
        return self.unexplained**2 / excess if excess > 0 else 0.0

    @property
    def scatters(self) -> bool:
        """Whether what is unexplained is worth telling: above 0.2 of the noise, 2 % more in all."""
        return self.unexplained > 0.2 * self.noise_floor

    @property
    def open(self) -> bool:
        """Whether no verdict may call the gap explained, or nothing: what is unexplained is more
        than LARGE of the gap, and more than the noise or of a joint that stands out."""
        beyond = self.joint_stands_out or self.unexplained > self.noise_floor
        return beyond and self.unexplained_share > LARGE


@dataclass(frozen=True)
class StructureTest:
    """Does the residual depend on the covariate `driver` at all?  Names no effect.

    It is "joint2 angle", "joint3 torque", "time", "load", "approach of joint1", ….  `p_value` by
    sign flips of whole configurations, for the largest statistic of the covariate's tests;
    `p_family` the same against the largest over all covariates."""

    driver: str
    p_value: float
    p_family: float


@dataclass(frozen=True)
class Curve:
    """The shape of an unknown dependence: motion of `entry` as a smooth function of a covariate,
    `driver`.

    `x` in `x_unit` over the measured range, `y` and its standard deviation `sd` in `y_unit`.
    One curve per component of the entry that moves."""

    driver: str
    x_unit: str
    entry: str
    y_unit: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    sd: tuple[float, ...]


@dataclass(frozen=True)
class Location:
    """Where the gap lies.  `evidence`: probability of each stage and of each place, and p-values
    that name no effect.

    Where many causes act at once, `stage` and `where` are those of the largest, the probabilities
    are that something acts there at all, and `shares` are those of each stage in the gap."""

    stage: Stage
    where: str
    probability: float
    stages: dict[str, float]
    places: dict[str, float]
    drivers: dict[str, float]
    shares: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, stage: Stage, where: str, stages: Mapping[str, float], places: Mapping[str, float],
        tests: Sequence[StructureTest], shares: Mapping[str, float] | None = None,
    ) -> Location:  # fmt: skip
        """Of the probabilities of stages and places, and shares: the largest of each first."""
        each = (stages, places, shares or {})
        ordered = (dict(sorted(one.items(), key=lambda item: -item[1])) for one in each)
        by_stage, by_place, of_stages = ordered
        shown = {t.driver: t.p_value for t in tests}
        return cls(stage, where, places.get(where, 0.0), by_stage, by_place, shown, of_stages)


@dataclass(frozen=True)
class FaultyReading:
    """A reading left out: line of the table, configuration, marker, error in m and in sigmas."""

    line: int
    configuration: str
    marker: str
    error: float
    sigmas: float


@dataclass(frozen=True)
class NearRepeats:
    """Readings at poses that nearly coincide, after the fitted model's own difference.

    `scatter` (m): rms per axis of a reading, over `pairs` of which so many are `independent`;
    `soon` and `later` the same of pairs measured one soon after the other and of the others, None
    where one of them has few."""

    scatter: float
    pairs: int
    independent: int
    soon: float | None = None
    later: float | None = None


@dataclass(frozen=True)
class NoiseFloor:
    """The noise that the data themselves show.

    `stated_factor`: tracker noise in units of what is stated (`stated` says whether anything
    was), `ratio_to_stated`: with the scatter of the joints.  `reading_sigma` (m): rms per axis of a
    single reading.  `repeatability` (joints,) in rad or m: scatter of each joint from visit to
    visit.  `shared`: scatter common to all visits of a configuration, as a multiple of it,
    `shared_by_joint` (joints,) that of each joint.  `pure_error` (m): rms per axis within repeats,
    `near_repeats`: what readings at nearly the same pose differ by, None without.  `drift` (m)
    and `configuration` (m per axis, common to one): what the cell states of them and nobody has to
    find."""

    stated: bool
    stated_factor: float
    ratio_to_stated: float
    reading_sigma: float
    repeatability: tuple[float, ...]
    shared: float
    pure_error: float | None
    shared_by_joint: tuple[float, ...] = ()
    faulty: tuple[FaultyReading, ...] = ()
    near_repeats: NearRepeats | None = None
    drift: float = 0.0
    configuration: float = 0.0


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(Result):
    """Why the real arm still differs from the model.

    Attributes:
        verdict: "explained", "nothing_significant", "unknown_effect" or "ambiguous".
        gap: 3-D rms marker errors on held-out poses, in m: nominal, calibrated, explained, floor.
        budget: The waterfall from the nominal arm to the noise floor, `Step` by step.
        effects: What is held to be real, each a `Finding`.
        candidates: Every hypothesis that was tried, best first.
        indistinguishable: Sets that these data cannot tell apart.
        location: Where the gap lies.
        noise: The noise that the data themselves show.
        structure: What the residual depends on, without naming an effect.
        probability_nothing: That no effect is missing.
        probability_unknown: That something without a name is at work.
        p_value: Of what was found, against the whole family of hypotheses; 0.0001 stands for that
            and all that is smaller.
        curves: The shape of an unknown dependence.
        untested: Effects that the data cannot test, and what to record so that they can.
        components: What errors of each kind at each place contribute, where many act at once.
        groups: The same by effect, at all its places: one finding each.
        fields: Corrections without a name, which explain nothing.
        slight: Of many causes those that move the markers by less than a hundredth of the gap's
            rms, or perhaps not at all: they correct the arm, and are no findings.
        findings: The judgements about it, the verdict first, each with its numbers and what to do.
        warnings: What to know before one relies on it, in sentences.
        n_readings: Number of readings; `n_configurations` that of configurations.
        extra: Poses that tell rivals apart, where they were asked for.
        model_keys: Keys of [model] that the effects found rest on.
        model: The model that was diagnosed; `data` names its measurements.
        calibrated: The arm as it was fitted before any effect was added.

    Examples:
        >>> why = ec.diagnose("cell.toml", "data.csv")
        >>> why.gap.nominal > why.gap.calibrated > why.gap.noise_floor
        True
        >>> why.save("diagnosis.json")
    """

    verdict: Verdict
    gap: Gap
    budget: tuple[BudgetStep, ...]
    effects: tuple[FoundEffect, ...]
    candidates: tuple[Candidate, ...]
    indistinguishable: tuple[tuple[EffectAt, ...], ...]
    location: Location | None
    noise: NoiseFloor
    structure: tuple[StructureTest, ...]
    probability_nothing: float
    probability_unknown: float
    p_value: float
    curves: tuple[Curve, ...] = ()
    untested: tuple[Untested, ...] = ()
    warnings: tuple[str, ...] = ()
    components: tuple[ComponentShare, ...] = ()
    groups: tuple[EffectGroup, ...] = ()
    fields: tuple[FoundEffect, ...] = ()
    slight: tuple[FoundEffect, ...] = ()
    n_readings: int = 0
    n_configurations: int = 0
    extra: ExtraPlan | None = field(default=None)
    model_keys: dict[str, str] = field(default_factory=dict)
    model: Model | None = field(default=None, repr=False, compare=False)
    data: str = field(default="", compare=False)
    calibrated: Baseline | None = field(default=None, repr=False, compare=False)

    @property
    def open(self) -> bool:
        """Whether rivals are left that poses can be designed for: of single causes, not of many
        that act at once."""
        return self.verdict in ("ambiguous", "unknown_effect") and not self.groups

    @property
    def doubtful(self) -> bool:
        """Whether, nothing being named, "no effect" would be the less likely half of the truth."""
        return self.probability_nothing < 0.5

    @property
    def dependences(self) -> tuple[StructureTest, ...]:
        """Covariates that the residual depends on, the most conspicuous first."""
        found = [t for t in self.structure if t.p_family <= STRUCTURE]
        return tuple(sorted(found, key=lambda t: t.p_family))

    @property
    def smallest_seen(self) -> float:
        """The rms motion of the markers (m) from which an effect would have been seen; NaN where
        there are no configurations.

        d² = Σ |δ|² / σ² per axis, with a configuration as one reading of the noise floor and of
        what is unexplained, in which effects hide as well: more readings and loads per
        configuration only make smaller effects visible."""
        independent = 3 * self.n_configurations
        hidden_in = math.hypot(self.gap.noise_floor, self.gap.unexplained)
        return VISIBLE * hidden_in / math.sqrt(independent) if independent else math.nan

    @property
    def findings(self) -> tuple[Finding, ...]:
        return tuple(_findings(self))

    def to_json(self) -> dict[str, Any]:
        """The diagnosis as a JSON-ready dictionary (DESIGN: diagnose → JSON).

        Lengths are in µm where the key says _um, everything else in the SI unit that stands beside
        it.  A number that is not known or not finite is null, as JSON has none."""
        model = self.model
        assert model is not None  # `diagnose` states it
        location = dict(vars(self.location)) if self.location else {}
        if location:
            parts = ("stages", "places", "drivers", "shares")
            location["evidence"] = {key: location.pop(key) for key in parts}
        content = {
            "schema": SCHEMA,
            "robot": model.chain.name,
            "cell": model.cell.name,
            "data": self.data,
            **{key: getattr(self, key, None) for key in PUBLISHED},
            "gap": _in_um(
                self.gap, "nominal", "calibrated", "explained", "noise_floor", "unexplained"
            ),
            "budget": [
                {"step": s.step, "heldout_rms_um": _um(s.heldout_rms), "ci95": _um(s.ci95)}
                for s in self.budget
            ],
            "effects": [_found(effect) for effect in self.effects],
            "components": [
                _in_um(c, "rms", "rms_ci95") | {"effect": c.effects[0]} for c in self.components
            ],
            "fields": [_found(effect) for effect in self.fields],
            "slight": [_found(effect) for effect in self.slight],
            "location": location or None,
            "noise": _noise(self.noise, model),
            "extra_plan": self.extra and {k: v for k, v in vars(self.extra).items() if k != "plan"},
            "backend": model.backend_report(),
        }
        return {key: plain(value) for key, value in content.items()}

    def __repr__(self) -> str:
        found = ", ".join(f"{f.effect} at {f.where}" for f in self.effects)
        if self.groups:
            found = ", ".join(f"{g.name} at {' '.join(g.places)}" for g in self.groups)
        robot = "" if self.model is None else f" {self.model.chain.name}"
        return f"<Diagnosis{robot}: {self.verdict}{', ' + found if found else ''}>"


def _findings(d: Diagnosis) -> Iterator[Finding]:
    numbers: dict[str, Any] = {
        "effects": tuple(f"{f.effect}:{f.where}" for f in d.effects),
        "p_value": d.p_value,
        "probability_nothing": d.probability_nothing,
        "probability_unknown": d.probability_unknown,
    }
    # "No effect" is no finding where it is the less likely half, or none would have been seen; nor
    # where the poses leave the model's own parameters as open.
    seen = any(c.visible for c in d.candidates) and d.gap.calibrated <= OPEN * d.gap.noise_floor
    unseen = d.verdict == "nothing_significant" and (d.doubtful or not seen)
    settled = d.verdict in ("explained", "nothing_significant") and not unseen
    remedy = UNSEEN if unseen else _remedy(d.verdict) * (not (settled and d.fields))
    yield Finding(d.verdict, "good" if settled else "care", numbers, remedy)
    if d.groups:
        shares = tuple(g.share for g in d.groups)
        low, high = zip(*(g.share_ci90 for g in d.groups), strict=True)
        names = tuple(f"{g.name}:{'+'.join(g.places)}" for g in d.groups)
        numbers = {"groups": names, "shares": shares, "shares_low": low, "shares_high": high}
        remedy = "" if settled else (
            "More poses over the whole range of every joint separate many simultaneous causes."
        )  # fmt: skip
        yield Finding("many_causes", "note", numbers, remedy)
    if d.verdict == "unknown_effect" and d.effects:
        numbers = {"effects": tuple(f"{f.effect}:{f.where}" for f in d.effects)}
        alone = _kept_back("the named effects added, and nothing for unknown ones: keep it")
        yield Finding("named_beside_unknown", "care", numbers, "" if d.fields else alone)
    if d.fields:
        numbers = {"fields": tuple(f"{f.effect}:{f.where}" for f in d.fields)}
        beside = "the effects named and " if d.effects else ""
        smooth = "unnamed smooth corrections: keep it"
        yield Finding("corrected_without_a_name", "care", numbers, _kept_back(beside + smooth))
    if d.slight:
        numbers = {"effects": tuple(f"{f.effect}:{f.where}" for f in d.slight)}
        yield Finding("slight_causes", "note", numbers)
    if d.open and d.extra is None:
        remedy = (
            f"{option('plan', 'extra.csv')} designs poses that separate the remaining hypotheses."
        )
        yield Finding("rivals_open", "note", {}, remedy)
    if d.dependences:
        drivers, p_family = zip(*((t.driver, t.p_family) for t in d.dependences), strict=True)
        yield Finding("depends_on", "note", {"drivers": drivers, "p_family": p_family})
    visible, hidden = (sum(c.visible for c in d.candidates), sum(c.hidden for c in d.candidates))
    numbers = {"smallest_seen_um": d.smallest_seen * MICRO, "candidates": len(d.candidates)}
    yield Finding("sensitivity", "note", numbers | {"visible": visible, "hidden": hidden})
    if d.noise.faulty:
        worst = max(f.error for f in d.noise.faulty) * MICRO
        numbers = {"left_out": len(d.noise.faulty), "worst_um": worst}
        yield Finding("faulty_readings", "note", numbers)


def _kept_back(has: str) -> str:
    return (
        f"The cell that {option('cell_out')} writes has {has} only where it does better on poses "
        f"kept back (identify with {option('test')})."
    )


OPEN = 2.0  # held-out error, in that of noise alone, beyond which parameters are most of it
UNSEEN = (
    "These readings do not show whether an effect is missing: measure more poses, spread over the "
    "whole range of every joint, and under more than one load."
)


def _remedy(verdict: Verdict) -> str:
    return {
        "explained": f"Identify with the cell that {option('cell_out')} writes, and check the "
        f"error on poses kept back (identify with {option('test')}).",
        "ambiguous": "The likeliest of the set compensates poses and loads like those measured; "
        "elsewhere the rivals may predict differently.",
        "unknown_effect": "Look for a physical cause at the place shown. Measure more where the "
        "curve is steep. Do not compensate by an effect that the data do not support.",
        "nothing_significant": "The model needs no further effect.",
    }[verdict]


SCHEMA = "elastocal/diagnosis/1"
PUBLISHED = (
    "verdict", "p_value", "probability_nothing", "probability_unknown", "gap", "budget", "effects",
    "components", "groups", "fields", "slight", "candidates", "indistinguishable", "location",
    "structure", "curves", "noise", "untested", "extra_plan", "model_keys", "warnings", "findings",
    "backend", "n_readings", "n_configurations",
)  # fmt: skip
NORMAL_95 = 1.959964


def _noise(noise: NoiseFloor, model: Model) -> dict[str, Any]:
    near, joints = noise.near_repeats, zip(noise.repeatability, model.chain.kinds, strict=True)
    return _in_um(noise, "reading_sigma", "drift", "configuration", "pure_error") | {
        "ratio_to_stated": noise.ratio_to_stated if noise.stated else None,
        "repeatability": [
            {"where": f"joint{i}", "value": value, "unit": "rad" if kind == "revolute" else "m"}
            for i, (value, kind) in enumerate(joints, 1)
        ],
        "near_repeat_um": near and _um(near.scatter),
        "near_repeats": near and {
            "pairs": near.pairs, "independent": near.independent,
            "soon_um": _um(near.soon), "later_um": _um(near.later),
        },
        "faulty": [_in_um(reading, "error") for reading in noise.faulty],
    }  # fmt: skip


def _um(length: Any) -> Any:
    """A length in m, several, or None, in µm."""
    if length is None:
        return None
    return [each * MICRO for each in length] if isinstance(length, tuple) else length * MICRO


def _in_um(part: Any, *lengths: str) -> dict[str, Any]:
    """Fields of a part of the result by name, the `lengths` in µm and named so."""
    return {
        f"{key}_um" if key in lengths else key: _um(value) if key in lengths else value
        for key, value in vars(part).items()
    }


def _found(f: FoundEffect) -> dict[str, Any]:
    def told(p: FittedParameter) -> dict[str, Any]:
        if math.isinf(p.std):
            return vars(p) | {"value": None, "ci95": None}
        return vars(p) | {"ci95": [p.value - NORMAL_95 * p.std, p.value + NORMAL_95 * p.std]}

    return vars(f) | {"parameters": [told(p) for p in f.parameters]}
