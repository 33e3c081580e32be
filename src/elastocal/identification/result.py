"""The frozen result of an identification: estimates, intervals, what could not be known."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from elastocal.above import KINDS, VIEWS, WORDS, DataFrame, Result, checked_arguments
from elastocal.cell_tables import Unsteadiness
from elastocal.identification import prediction, scrutiny
from elastocal.identification.faulty_readings import OutlierReport
from elastocal.identification.knowledge import ActiveConstraint
from elastocal.identification.least_squares import Covariance
from elastocal.identification.noise_structure import DRIFT, OF_CONFIGURATION
from elastocal.identification.noise_summary import ResidualSummary
from elastocal.identification.outliers import Outlier
from elastocal.measurements import NEVER_YET, Measurements
from elastocal.messages import (
    EXACT,
    ElastocalError,
    UnknownNameError,
    length,
    option,
    plain,
    require,
    rounded,
)
from elastocal.model import calibrated
from elastocal.model.effects.base import given_force
from elastocal.model.observations import COMPONENTS, observe
from elastocal.units import Array, microns

SCHEMA = "elastocal/identification/1"
FEW_POSES = 64  # of those over the workspace, for an rms
# What JSON has of a result in µm, and under its own name.
LENGTHS = ("residual_rms", "heldout_rms", "heldout_all_rms", "nominal_rms")
AS_THEY_ARE = (
    "residual_summary", "prior_share", "converged", "outliers", "excluded", "copies",
    "autocorrelation", "warnings", "findings", "method", "combinations", "covariance",
    "correlations", "dof", "noise", "faulty_report", "test",
)  # fmt: skip
LOPSIDED = 0.1  # difference of the halves of an interval that one half width cannot tell


@dataclass(frozen=True)
class Estimate:
    """What the data say of one parameter, in SI units.

    Attributes:
        name: As "joint2.compliance".
        unit: Its unit.
        nominal: Its nominal value.
        held: The value the fitted model uses for it: the estimate where there is one, else the
            value at which it was kept or the share of a combination that was put on it.  It is
            needed to predict, and it is not an estimate.
        value: The estimate; None, as `std` and `ci95`, unless the data determine it alone.
        std: Its standard deviation.
        ci95: Lower and upper end of its 95 % interval.
        dof: Degrees of freedom of the t distribution behind `ci95`, infinite for a normal one.
        combined_with: Names that the data know only together with it.
        note: Why there is no value, and what else there is to know.
        limits: Where the readings hardly show it, so that it has no value: the 95 % interval that
            they leave it, with ends beyond its physical bound.
    """

    name: str
    unit: str
    nominal: float
    held: float
    value: float | None = None
    std: float | None = None
    ci95: tuple[float, float] | None = None
    dof: float | None = None
    combined_with: tuple[str, ...] = ()
    note: str = ""
    limits: tuple[float, float] | None = None

    @property
    def identifiable(self) -> bool:
        """Do the data determine it alone?"""
        return self.value is not None

    def __str__(self) -> str:
        if self.value is None or self.std is None:
            others = ", ".join(self.combined_with)
            return f"{self.name}: no value" + (f", combined with {others}" if others else "")
        return f"{self.name} = {with_std(self.value, self.std)} {self.unit} (standard deviation)"


@dataclass(frozen=True)
class Combination:
    """A sum Σ factor·parameter that the data determine although its members they do not.

    `terms` maps parameter names to factors (SI units); deviations of all members but the first
    are counted from their `held` value, 0 where none is stated.  `value`, `std`, `ci95` in the
    first member's unit, `dof` as of an estimate.
    """

    terms: dict[str, float]
    unit: str
    value: float
    std: float
    ci95: tuple[float, float]
    held: dict[str, float] = field(default_factory=dict)
    dof: float = math.inf

    def __str__(self) -> str:
        return (
            f"{self.expression} = {with_std(self.value, self.std)} {self.unit} (standard deviation)"
        )

    @property
    def expression(self) -> str:
        """The sum as it was determined: "joint2.offset + 0.5·(link1.rz - 0.001)"."""
        return self.sum_of(self.terms, lambda factor: rounded(factor, 4), 6)

    def sum_of(self, names: Collection[str], size: Callable[[float], str], digits: int) -> str:
        """The first member and, of the others, those of these `names`."""
        first, *rest = self.terms
        text = first
        for name in (name for name in rest if name in names):
            number = size(abs(factor := self.terms[name]))
            number = "" if float(number) == 1 else f"{number}·"
            member, held = name, self.held.get(name)
            if held:  # as its deviation from there
                member = f"({name} {'-' if held > 0 else '+'} {abs(held):.{digits}g})"
            text += f" {'-' if factor < 0 else '+'} {number}{member}"
        return text

    def to_json(self) -> dict[str, Any]:
        return {
            "terms": self.terms, "held": {name: self.held.get(name, 0.0) for name in self.terms},
            "expression": self.expression, "unit": self.unit, "value": self.value,
            "std": self.std, "ci95": self.ci95,
        }  # fmt: skip


def with_std(value: float, std: float) -> str:
    """ "4.167e-07 ± 0.014e-07" as "(4.167 ± 0.014)e-07": the digits that the deviation allows."""
    if not (math.isfinite(std) and std > 0):
        return f"{value:.6g}"
    power = math.floor(math.log10(max(abs(value), std)))
    digits = max(power - math.floor(math.log10(std)) + 1, 1)
    shown = f"{value / 10.0**power:.{digits}f} ± {std / 10.0**power:.{digits}f}"
    return f"({shown})e{power:+03d}"


@dataclass(frozen=True)
class TestErrors:
    """Length of the position error on data never fitted, in m.

    Of the fit's own uncertainty there `std` is the rms in m, `most_fitted` the largest of any
    configuration fitted, predicted from the others; so many of the test `configurations` lie
    beyond it (`far`), as they would by chance with probability `p_far`.  NaN and 1 where the table
    is too large to say, or one configuration alone tells a parameter.  `errors` (n,) are all.
    """

    __test__ = False  # not a pytest class
    rms: float
    mean: float
    maximum: float
    n: int
    std: float = math.nan
    most_fitted: float = math.nan
    far: int = 0
    configurations: int = 0
    p_far: float = 1.0
    errors: Array = field(default_factory=lambda: np.zeros(0), compare=False)

    def to_json(self) -> dict[str, float | None]:
        known = math.isfinite(self.std)
        return {
            "rms_um": microns(self.rms), "mean_um": microns(self.mean),
            "max_um": microns(self.maximum), "n": self.n, "predicted_std_um": microns(self.std),
            "fitted_std_um": microns(self.most_fitted),
            "far": self.far if known else None, "p_far": self.p_far if known else None,
        }  # fmt: skip


Severity = Literal["good", "note", "care", "poor"]


@dataclass(frozen=True)
class Finding:
    """A judgement about a result: what was found, how bad it is, by which numbers, what to do.

    `severity` is good (it speaks for the result), note (worth knowing), care (use the result
    knowing this) or poor (do not use it).  `numbers` are those that the judgement rests on, with
    units in their names, several as a tuple, None where one is not known; `remedy` is a sentence,
    empty where nothing needs to be done.
    """

    kind: str
    severity: Severity
    numbers: dict[str, Any] = field(default_factory=dict)
    remedy: str = ""

    def number(self, name: str) -> float:
        """One of the numbers; infinite where it is not known."""
        value = self.numbers[name]
        return value if isinstance(value, float | int) else math.inf


AT_BOUND = (
    "Check load direction and torque signs, measure poses that load it more, or fit with bounds."
)


def more_poses() -> str:
    return (
        f"Measure more poses: elastocal design with {option('augment')} plans what these data lack."
    )


def remedies() -> dict[str, str]:
    """What to do about findings of a kind, options named as messages do now; of others it depends
    on more."""
    return {
        "autocorrelated": "Visit poses and loads in random order and return to a reference pose "
        "every ten poses: residuals of visits that follow each other are alike, as where something "
        "drifts, or where the model lacks what neighbouring poses have in common.",
        "beyond_bound": AT_BOUND,
        "copied_readings": "Find out how lines came to be in the table twice; readings that were "
        "rounded until they agree should be given with all their digits.",
        **dict.fromkeys(("few_configurations", "fit_flatters", "new_poses_no_gain"), more_poses()),
        "few_degrees_of_freedom": "Measure more poses.",
        "hardly_shown": "Strain what the readings hardly show by a larger load, or one in another "
        "direction ([design] loads_N, for which elastocal design plans poses), or give it a prior.",
        "ill_conditioned": "Measure poses in which the joints differ more, or fix one of these "
        "parameters.",
        "knowledge_contradicted": "Check names, units and signs of what is stated, and whether the "
        "model lacks an effect.",
        "many_faulty_readings": "Check where they lie before excluding any.",
        "not_converged": "Give start hints in [model.nominal], fit fewer effects, or measure more "
        "poses.",
        "residual_below_stated_noise": "State the tracker's true noise: with noise stated too "
        "large, a missing effect does not show.",
        "residuals_heavy_tailed": f"Compare with a robust fit ({option('method')} huber or l1): "
        "where parameters differ by more than their intervals, far readings decide them; look for "
        "what makes single readings err (line of sight, vibration, a tracker that has not "
        "settled).",
        "test_data_far": "Measure poses like those of the test: the fit extrapolates to them.",
        "test_data_worse": "Compare the test poses with those fitted: where they lie elsewhere "
        "(joints, load), fit some like them; where they do not, the arm, its markers or the "
        "tracker have changed in between, or time_s of both counts from different moments.",
        "trust": "Use it (elastocal compensate, elastocal export) where poses and loads are like "
        "those measured.",
        "untested": "Validate on independent poses: measure some that are not fitted, and give "
        f"them with {option('test')}.",
    }


def made(severity: Severity, kind: str, remedy: str | None = None, /, **numbers: Any) -> Finding:
    """A finding with the remedy of its kind unless one is given; numbers whose names end in _um or
    _urad are given in m and rad."""
    for name, value in numbers.items():
        if name.endswith(("_um", "_urad")):
            several = isinstance(value, tuple)
            numbers[name] = tuple(v * 1e6 for v in value) if several else float(value) * 1e6
    remedy = remedies().get(kind, "") if remedy is None else remedy
    return Finding(kind, severity, numbers, remedy)


@dataclass(frozen=True)
class Verdict:
    """Can the calibration be used, and how far is it to be trusted?

    Trusted at `at` (m) means: where the arm will be used its noise-free position error is at most
    that (3-D rms over the poses), with 97.5 % probability, and nothing is `missing` that this
    rests on: configurations beyond the parameters, a residual that the noise explains, a predicted
    error.  `tone` is good (trusted), care (what is missing is named), poor (do not use it).
    """

    tone: Severity
    at: float | None
    missing: tuple[Finding, ...]

    @property
    def trusted(self) -> bool:
        return self.tone == "good"

    def to_json(self) -> dict[str, Any]:
        """JSON-ready; None where no error at new poses can be told."""
        return {
            "tone": self.tone, "trusted": self.trusted,
            "at_um": microns(self.at),
            "missing": [f.kind for f in self.missing],
        }  # fmt: skip


@dataclass(frozen=True, repr=False, eq=False)
class Calibration(scrutiny.FoundFit, Result, Mapping[str, Estimate]):
    """What `identify` found: a mapping from parameter names to `Estimate`s, and all around it.

    Attributes:
        model: The `Model` that was fitted.
        method: The method that was used.
        noise: The noise model and what was estimated of it.
        estimates: An `Estimate` per parameter, in the model's order; `fit["joint2.compliance"]`
            is one of them.
        combinations: Sums of parameters that the data determine although not each member.
        x: Values (parameters,) that the model uses, in SI units.
        determined: The kept parameters in order, alone or as first member of a combination.
        spread: Their `Covariance`, with degrees of freedom; `covariance` is its matrix.
        correlations: Pairs of names with |ρ| over 0.9, strongest first.
        observations: The readings that were fitted, as observations.
        residual: (rows,), observed minus predicted, in m (rad).
        held_out: The same with each configuration predicted by a fit to the others.
        held_out_told: Mean square in m² that the uncertainty of those fits has in it, and degrees
            of freedom of its own, 0 where none could be held out.
        sigma: Standard deviation of the residual per whitened row (in m with unit weights).
        dof: Its degrees of freedom.
        residual_rms: 3-D rms of `residual`, in m.
        heldout_rms: That of `held_out`, without readings that were set apart and configurations
            that alone determine something.  Infinite where a tenth of all or more do.
        nominal_rms: That of the nominal arm, placed but not calibrated.
        converged: Whether the fit converged; `reason` says how it ended.
        outliers: Readings beyond the noise that had a part in the fit.
        excluded: Readings beyond the noise that were set apart.
        smooth: The smooth functions of the model (`SmoothPart`), whose parameters are many and
            have a prior.
        findings: The judgements about all this, each with its numbers and what to do.
        warnings: What to know before one relies on the result, in sentences.
        test: Errors on the readings given as `test`, None without.
        active: Constraints that hold with equality.
        prior_share: By parameter the share of its information that the prior gave, 0 to 1; empty
            without a prior.
        left: The parameters that the data left open, and what they stand for.
        predicted: The error to be expected at poses that nobody measured, without the noise of
            a reading; None where it cannot be told.
        copies: Lines of readings that were left out: they repeat others to the last digit.
        weights: Those of the fit.
        noise_parts: Mean square 3-D noise (m²) of single "readings", and what readings of
            "visits" have in common.
        shown: How sure the fit is where it was measured; None of a large table.
        scatter: The covariance that configurations tell, where no known noise explains the
            residual.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv")
        >>> fit
        <Calibration kuka_kr270_2: 9 of 10 parameters, held-out 124 µm>
        >>> stiff = fit["joint3.compliance"]
        >>> stiff.value, stiff.std, stiff.ci95, stiff.unit
        (4.1...e-07, 1...e-09, (4.1...e-07, 4.1...e-07), 'rad/(N*m)')
        >>> fit["joint1.compliance"].identifiable, len(fit), fit.covariance.shape, fit.B.shape
        (False, 10, (9, 9), (810, 10))
        >>> [name for name in fit if not fit[name].identifiable]
        ['joint1.compliance']
    """

    method: str
    estimates: tuple[Estimate, ...]
    combinations: tuple[Combination, ...]
    spread: Covariance
    correlations: tuple[tuple[str, str, float], ...]
    sigma: float
    held_out_told: tuple[float, float]
    heldout_rms: float
    nominal_rms: float
    converged: bool
    reason: str
    outliers: tuple[Outlier, ...]
    excluded: tuple[Outlier, ...]
    warnings: tuple[str, ...]
    test: TestErrors | None = None
    residual_summary: ResidualSummary | None = None
    faulty_report: OutlierReport | None = None
    active: tuple[ActiveConstraint, ...] = ()
    prior_share: dict[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    left: calibrated.OpenParameters | None = None
    predicted: prediction.PredictedError | None = None
    copies: tuple[int, ...] = ()
    shown: calibrated.ShownPoses | None = None
    scatter: calibrated.Scatter | None = None

    @property
    def covariance(self) -> Array:
        """(determined, determined), of the parameters `determined`."""
        return self.spread.matrix

    @property
    def correlation(self) -> Array:
        """(determined, determined), ρ of the same parameters: `covariance` over their `std`."""
        return self.spread.correlation

    @property
    def unsteadiness(self) -> Unsteadiness:
        """What the readings show of the cell's [noise]: `replace(cell, noise=fit.unsteadiness)` is
        a cell whose plans and simulations have it."""
        sizes = {s.name: s.sigma or 0.0 for s in self.noise.sizes or ()}
        lasting = None if self.noise.drift is None else self.noise.drift.seconds
        joints, _ = self.noise.scatter(self.model.chain.n_joints)
        if not joints.any():
            joints = np.zeros(1)
        own, drift = (sizes.get(name, 0.0) for name in (OF_CONFIGURATION, DRIFT))
        lasting, drift = (lasting, drift) if lasting else (Unsteadiness.lasting, 0.0)
        return Unsteadiness(joints, drift, lasting, own)

    @cached_property
    def ordinary(self) -> tuple[Estimate, ...]:
        """The estimates of all parameters but those of smooth functions."""
        each = zip(self.estimates, self.model.parameters, strict=True)
        return tuple(e for e, p in each if not p.shrunk)

    @property
    def verdict(self) -> Verdict:
        """The judgement that terminal, page, notebook and JSON give."""
        doubts = (f for f in self.findings if f.kind != "trust" and f.severity in ("care", "poor"))
        trust, found = self.finding("trust"), self.predicted
        at = None if found is None else found.ci95[1]
        return Verdict("care" if trust is None else trust.severity, at, tuple(doubts))

    def unmet(self, **limits: float | None) -> tuple[str, ...]:
        """What of the required accuracy is not kept, a sentence for each; empty where all is.

        Args:
            **limits: `heldout`, `new_poses` and `test` in m, 3-D rms (`new_poses`: the upper end
                of the 95 % interval); by default those of the cell ([require]).

        Raises:
            UnknownNameError: A limit of another name.
            InputError: It is no positive number.

        Examples:
            >>> fit = ec.identify("cell.toml", "data.csv")
            >>> fit.unmet(heldout=1e-3)
            ()
            >>> fit.unmet(heldout=1e-6)
            ('heldout: 124 µm where at most 1 µm is required',)
        """
        found = {
            "heldout": self.heldout_rms,
            "new_poses": math.inf if self.predicted is None else self.predicted.ci95[1],
            "test": math.inf if self.test is None else self.test.rms,
        }
        told = []
        for name, most in (vars(self.model.cell.require) | limits).items():
            if name not in found:
                raise UnknownNameError.of("limit", name, found)
            good = most is None or (KINDS["float"][1](most) and most > 0)
            require(good, f"{option(name)} takes a positive number in m or None; found {most!r}")
            if most is not None and not found[name] <= most:
                value = length(found[name]) if math.isfinite(found[name]) else "not known"
                if name == "test" and self.test is None:
                    value += f" without readings to test ({option('test')})"
                told.append(f"{name}: {value} where at most {rounded(most * 1e6)} µm is required")
        return tuple(told)

    def certificate(
        self, path: str | Path, *, inputs: Any = None, command: str | None = None,
        seed: int | None = None,
    ) -> None:  # fmt: skip
        """Write the calibration certificate: one HTML page to print and file away, or its XML.

        Entries of [certificate] in the cell (ISO/IEC 17025), statement of conformity, expanded
        uncertainty and its budget, pose accuracy before and after and repeatability in the sense
        of ISO 9283, instrument, loads, SHA-256 of cell and data, verdict.  Without the entries it
        is called a report.

        Args:
            path: The page; where it ends in .xml, a digital calibration certificate (DCC).
            inputs: As for `report`, like the others.
            command: The command line that repeats the run, where there is one.
            seed: The seed of the run, to be named.

        Raises:
            InputError: An input cannot be read, the page not written, or an entry is missing
                that a digital certificate needs.

        Examples:
            >>> ec.identify("cell.toml", "data.csv").certificate("certificate.html")
        """
        import_module(VIEWS).write_page(self, path, inputs, command, seed, certificate=True)

    @property
    def faulty(self) -> tuple[Outlier, ...]:
        """Readings beyond the noise, whether they had a part in the fit or were set apart."""
        return self.outliers + self.excluded

    @property
    def held_out_counted(self) -> Array:
        """The rows of `held_out` that `heldout_rms` is of."""
        known = np.isfinite(self.held_out) | math.isinf(self.heldout_rms)
        return self.held_out[known]

    @property
    def heldout_all_rms(self) -> float:
        """The held-out 3-D rms in m with the readings that were set apart, by their errors under
        the fit to the others; infinite where none could be held out."""
        apart = sum(o.residual**2 for o in self.excluded)
        n, k = len(self.held_out_counted) / self.observations.size, len(self.excluded)
        return math.sqrt((n * self.heldout_rms**2 + apart) / (n + k))

    def __getitem__(self, name: str) -> Estimate:
        """The estimate of the parameter `name`; UnknownNameError with the nearest name."""
        if name not in self._by_name:
            raise UnknownNameError.of("parameter", name, self._by_name)
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        """The parameters' names, in the model's order."""
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self.estimates)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._by_name)

    @cached_property
    def _by_name(self) -> dict[str, Estimate]:
        return {e.name: e for e in self.estimates}

    def __repr__(self) -> str:
        known = sum(e.identifiable for e in self.ordinary)
        held = f", held-out {length(self.heldout_rms)}" if self.heldout_rms < np.inf else ""
        functions = f", {len(self.smooth)} smooth functions" if self.smooth else ""
        return (
            f"<Calibration {self.model.chain.name}: {known} of {len(self.ordinary)} parameters"
            f"{functions}{held}>"
        )

    @property
    def _looks(self) -> bool:
        """Whether to look again: not at a table too large to do it in passing, an exact fit, which
        leaves nothing to look at, and one that priors or bounds hold as well: what a configuration
        decides there is not said by B alone."""
        numbers = len(self.residual) * len(self.estimates)
        others = self.prior_share or self.smooth or self.active
        return not others and bool(self.residual.any()) and numbers <= scrutiny.MOST_NUMBERS

    def influence(self) -> tuple[scrutiny.Influence, ...]:
        """Leverage and influence of every configuration, in the table's order; empty for tables
        too large to look again.

        Examples:
            >>> found = ec.identify("cell.toml", "data.csv").influence()
            >>> strongest = max(found, key=lambda c: c.cook)
            >>> strongest.configuration, strongest.leverage, strongest.moved
            ('...', 1..., 'joint...')
        """
        return scrutiny.influence(self) if self._looks else ()

    def parameter_sets(self) -> tuple[scrutiny.ParameterSet, ...]:
        """Sets of parameters side by side: held-out errors and restricted likelihoods."""
        return scrutiny.parameter_sets(self) if self._looks else ()

    @checked_arguments
    def uncertainty(self, table: Measurements | None = None) -> scrutiny.UncertaintyBudget | None:
        """What a predicted reading's error is made of, at the poses and loads of a `table` or those
        fitted; None for tables too large to look again."""
        table = None if table is None else self.as_visited(table)
        fitted = 0.0 if self.excess is None else self.excess.fitted
        return scrutiny.uncertainty_budget(self, self.arm, fitted, table) if self._looks else None

    @cached_property
    def autocorrelation(self) -> scrutiny.Autocorrelation | None:
        """How alike the residuals of visits are that follow each other; None for few visits."""
        return scrutiny.autocorrelation(self.residual, self.observations)

    @cached_property
    def arm(self) -> calibrated.CalibratedArm:
        """The calibrated arm, in memory: to be commanded (`compensate`), posed and saved."""
        lacking = 0.0 if self.excess is None else float(np.sqrt(self.excess.squared.mean()))
        read = self.observations
        return calibrated.CalibratedArm(
            self.model, self.x, self.determined, self.covariance, read.table.source,
            tuple(map(_estimate_json, self.estimates)), self.left, lacking,
            prediction.measured_loads(read), self.shown, prediction.measured_visits(read),
            calibrated.mostly_prior(self.prior_share), self.scatter,
            import_module(WORDS).doubt_of(self) if self.findings else "",
        )  # fmt: skip

    @cached_property
    def load_point_error(self) -> float | None:
        """Rms in m to which the load point is known at new poses, where that is more than the
        verdict says of the markers: nothing measured tells where it lies among them.

        It is the default point of `compensate`.  None where it is known as well, or not stated,
        and of deflections.
        """
        cell, at, read = self.model.cell, self.verdict.at, self.observations
        if not cell.tool.load_point.any() or at is None or cell.model.observe == "deflection":
            return None
        poses = prediction.over_the_workspace(cell, self.model, read.table)
        like = read.table.take(np.resize(read.lead, FEW_POSES))  # in time and all else
        table = replace(like, q=poses.q[:FEW_POSES], force=poses.force[:FEW_POSES])
        try:
            tool = calibrated.CalibratedTool(self.arm, calibrated.tool_point(cell, None))
            found = prediction.position_at(tool, table, self.noise, self.spread)
        except ElastocalError:
            return None
        rms = float(np.sqrt(np.nanmean(np.trace(found.covariance, axis1=1, axis2=2))))
        return rms if rms > max(at, EXACT) else None

    @cached_property
    def excess(self) -> prediction.Excess | None:
        """By how much configurations scatter beyond their noise; None where nothing tells it.
        Readings that were set apart may be what the model lacks, and no accidents: each counts
        there as much as the worst that was kept, at most."""
        rng, (own, dof) = np.random.default_rng(0), self.held_out_told
        rows = len(self.residual)
        scatter = self.residual_rms**2 * rows / max(self.dof, 1), self.dof, rows
        each = (self.held_out.reshape(-1, self.observations.size)[:, :3] ** 2).sum(axis=1)
        told = each[np.isfinite(each)]
        apart = np.array([o.residual for o in self.excluded]) ** 2
        told = np.append(told, np.minimum(apart, told.max(initial=0.0)))
        left_out = float(told.mean()) if dof else 0.0
        return prediction.excess_of(scatter, (left_out, dof), own, self.noise, rng)

    @checked_arguments
    def position(
        self, q: ArrayLike, load: ArrayLike | None = None, point: str | None = None
    ) -> prediction.Position:
        """Where the tool is at any pose, with covariance and region.

        Args:
            q: Commanded joints (joints,) or (n, joints), in rad or m.
            load: Force (3,) or (n, 3) in N at the load point, in the data's frame; default none.
            point: A marker, or "x,y,z" in m in the flange frame; default the cell's load point,
                else its only marker.

        Returns:
            The `Position` of n poses: place, its covariance, the scatter of a single visit, and
            the half axes of its region.

        Raises:
            InputError: A shape does not fit, the point is unknown, or the model needs more than
                joints and load.

        Examples:
            >>> fit = ec.identify("cell.toml", "data.csv")
            >>> at = fit.position([0.0, -1.0, 1.0, 0.0, 0.5, 0.0], load=[0, 0, -2600])
            >>> at.position.shape, at.covariance.shape, bool((at.half_axes() < 1e-3).all())
            ((1, 3), (1, 3, 3), True)
        """
        model = self.model
        given_force(load, len(model.table(q)))
        tool = calibrated.CalibratedTool(self.arm, calibrated.tool_point(model.cell, point))
        table = model.table(q, load).from_neither_side()
        return prediction.position_at(tool, table, self.noise, self.spread)

    @checked_arguments
    def predict(
        self, q: ArrayLike | Measurements | DataFrame, load: ArrayLike | None = None
    ) -> Array:
        """Where the tool is at any pose, (n, 3) in m: `position` without its uncertainty; of a
        table (measurements, a plan, a data frame) what its readings should be, (n, components).  A
        table without a reading that was fitted is of another session, as `test` of `identify`."""
        table = self.model.read(q) if hasattr(q, "to_csv") else q
        if isinstance(table, Measurements):
            require(load is None, f"{option('load')} goes with joints; a table states its own")
            table = self.as_visited(table)
            if (table.distance if self.model.observe == "distance" else table.position) is None:
                blank = np.zeros((len(table), 3))  # what a plan reads counts for nothing
                table = replace(table, position=blank, rotation=blank, distance=blank[:, 0])
            observed = observe(table, self.model.observe)
            return self.model.predict(table, self.x, observed).reshape(-1, observed.size)
        return self.position(table, load).position

    def as_visited(self, table: Measurements) -> Measurements:
        """The table; without a reading that was fitted it is of another session: nobody knows how
        the arm came to it, and where jumps are told by lines it comes after all that were."""
        fitted = self.observations.table
        if prediction.fitted_too(table, fitted):
            return table
        if self.model.cell.model.clock == "rows":
            table = replace(table, row=table.row + int(NEVER_YET))
        return table.from_neither_side()

    @property
    def params(self) -> dict[str, float]:
        """The values that the model uses, by parameter, in SI units."""
        return dict(zip(self.model.names, self.x.tolist(), strict=True))

    @property
    def residuals(self) -> Array:
        """Observed minus predicted (observations, components), in m (rad)."""
        return self.residual.reshape(-1, self.observations.size)

    def to_dict(self) -> dict[str, Any]:
        """The result as the dictionary that `save` writes as JSON."""
        return self.to_json()

    def combination(self, first: str) -> Combination:
        """The combination whose first member is `first`; UnknownNameError where there is none."""
        found = {next(iter(c.terms)): c for c in self.combinations}
        if first not in found:
            raise UnknownNameError.of("combination that starts with", first, found)
        return found[first]

    def finding(self, *kinds: str) -> Finding | None:
        """The first finding of one of these kinds; None where there is none."""
        return next((f for f in self.findings if f.kind in kinds), None)

    def residual_table(self) -> list[dict[str, Any]]:
        """One row per observation: line, configuration, repeat, marker, residuals in µm (µrad)."""
        observed, table = self.observations, self.observations.table
        held, rows = self.held_out.reshape(-1, observed.size), list[dict[str, Any]]()
        for i, own, left_out in zip(observed.lead, self.residuals, held, strict=True):
            row: dict[str, Any] = {
                "line": int(table.row[i]),
                "configuration": table.configuration_labels[table.configuration[i]],
                "repeat": int(table.repeat[i]),
                "marker": table.marker_names[table.marker[i]],
            }
            for name, *each in zip(COMPONENTS[observed.kind], own, left_out, strict=True):
                unit = "urad" if name.startswith("r") else "um"
                for of, value in zip(("residual", "heldout"), each, strict=True):
                    row[f"{of}_{name}_{unit}"] = float(value) * 1e6
            rows.append(row)
        return rows

    def to_json(self) -> dict[str, Any]:
        """The result as a JSON-ready dictionary (DESIGN: identify → JSON)."""
        chain, observed, off = self.model.chain, self.observations, self.unsteadiness
        tested = {} if self.test is None else self.test.to_json()
        said = import_module(WORDS).judgement(self).sentence if self.findings else None
        against = {"sentence": said, "doubt": self.arm.doubt}
        return plain({
            "schema": SCHEMA,
            "robot": chain.name,
            "joints": [joint.name for joint in chain.joints],
            "nominal_flange": calibrated.nominal_flange_rows(chain),
            "cell": self.model.cell.name,
            "data": observed.table.source,
            "parameters": [_estimate_json(e) for e in self.estimates],
            "covariance_of": self.determined,
            "loads_N": prediction.measured_loads(observed),
            "n_rows": len(self.residual),
            "n_readings": len(observed.lead),
            "heldout_kept_rms_um": microns(self.heldout_rms),
            **{f"{name}_um": microns(getattr(self, name)) for name in LENGTHS},
            **{f"test_{name}": tested.get(name) for name in ("rms_um", "mean_um", "max_um")},
            "verdict": self.verdict.to_json() | against,
            "predicted_new_poses_um": self.predicted,
            "load_point_um": microns(self.load_point_error),
            "measured_visits": self.arm.visits,
            "measured_poses": self.shown,
            "open": self.left,
            "tails": None,
            "cell_noise": {
                "joints_urad": 1e6 * off.joints, "drift_um": microns(off.drift),
                "lasting_s": off.lasting, "configuration_um": microns(off.configuration),
                "tails": None,
            },
            "active": [
                {"label": a.label, "kind": a.kind, "parameters": a.names,
                 "value": a.value, "multiplier": a.multiplier}
                for a in self.active
            ],
            "smooth": [entry for part in self.smooth for entry in part.to_json()],
            "backend": self.model.backend_report(),
            "influence": self.influence(),
            "parameter_sets": self.parameter_sets(),
            "uncertainty": self.uncertainty(),
            **{name: getattr(self, name) for name in AS_THEY_ARE},
            **({} if self.scatter is None else {"scatter": self.scatter}),
        })  # fmt: skip


def _estimate_json(e: Estimate) -> dict[str, Any]:
    ends = zip(("lower", "upper"), e.ci95 or (0.0, 0.0), strict=True)
    endless = " or ".join(name for name, v in ends if not np.isfinite(v))
    note = e.note or (f"the data set no {endless} limit to it" if endless else "")
    told = vars(e) | {"identifiable": e.identifiable, "note": note}
    limits = told.pop("limits")
    return dict(plain(told if limits is None else told | {"limits95": limits}))
