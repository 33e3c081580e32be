"""The frozen result of an identification: estimates, intervals, what could not be known."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.constrained.minimise import ActiveConstraint
from elastocal.identification.noise_summary import Noise
from elastocal.identification.outlier import Outlier
from elastocal.identification.residual_summary import ResidualSummary
from elastocal.identification.robust.report import OutlierReport
from elastocal.manipulator.calibrated import nominal_flange_rows
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import COMPONENTS, Observations
from elastocal.notebook import ForNotebooks

Array = NDArray[np.float64]

SCHEMA = "elastocal/identification/1"
LOPSIDED = 0.1  # difference of the halves of an interval that one half width cannot tell


@dataclass(frozen=True)
class Estimate:
    """One parameter.  `value`, `std`, `ci95` are None unless the data determine it alone.

    `dof` are the degrees of freedom of the t distribution behind `ci95`, infinite for a normal one.

    `held` is the value the fitted model uses for it: the estimate where there is one, else the
    value at which it was kept or the share of a combination that was put on it.  It is needed
    to predict, and it is not an estimate.
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

    @property
    def identifiable(self) -> bool:
        return self.value is not None


@dataclass(frozen=True)
class Combination:
    """A sum Σ factor·parameter that the data determine although its members they do not.

    `terms` maps parameter names to factors (SI units); deviations of all members but the first
    are counted from their `held` value, 0 where none is stated.  `value`, `std`, `ci95` in the
    first member's unit.
    """

    terms: dict[str, float]
    unit: str
    value: float
    std: float
    ci95: tuple[float, float]
    held: dict[str, float] = field(default_factory=dict)

    @property
    def expression(self) -> str:
        """The sum as it was determined: "joint2.offset + 0.5·(link1.rz - 0.001)"."""
        first, *rest = self.terms.items()
        text = first[0]
        for name, factor in rest:
            number = f"{abs(factor):.4g}"
            size = "" if number == "1" else f"{number}·"
            text += f" {'-' if factor < 0 else '+'} {size}{deviation(name, self.held.get(name))}"
        return text


def deviation(name: str, held: float | None, digits: int = 6) -> str:
    """A parameter as its deviation from where it is held: "(link1.rz - 0.001)"; plain from 0."""
    if not held:
        return name
    return f"({name} {'-' if held > 0 else '+'} {abs(held):.{digits}g})"


@dataclass(frozen=True)
class TestErrors:
    """Length of the position error on data never fitted, in m."""

    __test__ = False  # not a pytest class
    rms: float
    mean: float
    maximum: float
    n: int


Severity = Literal["good", "note", "care", "poor"]
Number = float | str | tuple[float, ...] | tuple[str, ...] | None


@dataclass(frozen=True)
class Finding:
    """A judgement about a result: what was found, how bad it is, by which numbers, what to do.

    `severity` is good (it speaks for the result), note (worth knowing), care (use the result
    knowing this) or poor (do not use it).  `numbers` are those that the judgement rests on, with
    units in their names; `remedy` is a sentence, empty where nothing needs to be done.
    """

    kind: str
    severity: Severity
    numbers: dict[str, Number] = field(default_factory=dict)
    remedy: str = ""

    def number(self, name: str) -> float:
        """One of the numbers; infinite where it is not known."""
        value = self.numbers[name]
        return value if isinstance(value, float | int) else math.inf

    def listed(self, name: str) -> tuple[float | str, ...]:
        """Those of the numbers that are several."""
        value = self.numbers[name]
        return value if isinstance(value, tuple) else ()

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; what is not finite is None."""
        numbers = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in self.numbers.items()
        }
        return {
            "kind": self.kind, "severity": self.severity, "numbers": numbers, "remedy": self.remedy,
        }  # fmt: skip


@dataclass(frozen=True)
class Calibration(ForNotebooks):
    """What `identify` found.

    `x` (parameters,) are the values the model uses; `covariance` (determined, determined) goes
    with `determined`, the kept parameters in order (alone or as first member of a combination).
    `residual` (rows,) observed minus predicted in m (rad); `held_out` the same with each
    configuration predicted by a fit to the others.  `sigma` is the residual's standard
    deviation per whitened row (in m where unit weights were used), with `dof` degrees of freedom.
    `active` are the constraints that hold with equality; `prior_share` says by parameter what
    share of its information the prior gave, 0 to 1 (empty without a prior; parameters that
    equalities fix are left out).  `findings` are the judgements about all this, each with its
    numbers and what to do; `warnings` says those in sentences that call for attention.
    """

    model: Model
    method: str
    noise: Noise
    estimates: tuple[Estimate, ...]
    combinations: tuple[Combination, ...]
    x: Array
    determined: tuple[str, ...]
    covariance: Array
    correlations: tuple[tuple[str, str, float], ...]
    observations: Observations
    residual: Array
    held_out: Array
    sigma: float
    dof: int
    residual_rms: float
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

    @property
    def faulty(self) -> tuple[Outlier, ...]:
        """Readings beyond the noise, whether they had a part in the fit or were set apart."""
        return self.outliers + self.excluded

    def estimate(self, name: str) -> Estimate:
        """The estimate of one parameter by name; KeyError lists what exists."""
        for e in self.estimates:
            if e.name == name:
                return e
        raise KeyError(f"no parameter '{name}'; there are {[e.name for e in self.estimates]}")

    def combination(self, first: str) -> Combination:
        """The combination whose first member is `first`."""
        for c in self.combinations:
            if next(iter(c.terms)) == first:
                return c
        raise KeyError(f"no combination starts with '{first}'")

    def finding(self, *kinds: str) -> Finding | None:
        """The first finding of one of these kinds; None where there is none."""
        return next((f for f in self.findings if f.kind in kinds), None)

    def residual_table(self) -> list[dict[str, Any]]:
        """One row per observation: line, configuration, repeat, marker, residuals in µm (µrad)."""
        seen = self.observations
        parts = self.residual.reshape(-1, seen.size)
        held = self.held_out.reshape(-1, seen.size)
        rows = []
        for k, i in enumerate(seen.lead):
            row: dict[str, Any] = {
                "line": int(seen.table.row[i]),
                "configuration": seen.table.configuration_labels[seen.table.configuration[i]],
                "repeat": int(seen.table.repeat[i]),
                "marker": seen.table.marker_names[seen.table.marker[i]],
            }
            for j, name in enumerate(COMPONENTS[seen.kind]):
                unit = "urad" if name.startswith("r") else "um"
                row[f"residual_{name}_{unit}"] = float(parts[k, j]) * 1e6
                row[f"heldout_{name}_{unit}"] = float(held[k, j]) * 1e6
            rows.append(row)
        return rows

    def to_json(self) -> dict[str, Any]:
        """The result as a JSON-ready dictionary (DESIGN: identify → JSON)."""
        return {
            "schema": SCHEMA,
            "robot": self.model.chain.name,
            "nominal_flange": nominal_flange_rows(self.model.chain),
            "cell": self.model.cell.name,
            "data": self.observations.table.source,
            "method": self.method,
            "parameters": [_estimate_json(e) for e in self.estimates],
            "combinations": [
                {"terms": c.terms, "held": {name: c.held.get(name, 0.0) for name in c.terms},
                 "expression": c.expression, "unit": c.unit,
                 "value": c.value, "std": _finite(c.std), "ci95": [_finite(v) for v in c.ci95]}
                for c in self.combinations
            ],
            "covariance": self.covariance.tolist(),
            "covariance_of": list(self.determined),
            "correlations": [list(c) for c in self.correlations],
            "n_rows": len(self.residual),
            "n_readings": len(self.observations.lead),
            "dof": self.dof,
            "residual_rms_um": _um(self.residual_rms),
            "heldout_rms_um": _um(self.heldout_rms),
            "nominal_rms_um": _um(self.nominal_rms),
            "test": None if self.test is None else {
                "rms_um": _um(self.test.rms), "mean_um": _um(self.test.mean),
                "max_um": _um(self.test.maximum), "n": self.test.n,
            },
            "test_rms_um": None if self.test is None else _um(self.test.rms),
            "test_mean_um": None if self.test is None else _um(self.test.mean),
            "test_max_um": None if self.test is None else _um(self.test.maximum),
            "noise": self.noise.to_json(),
            "residual_summary": (
                None if self.residual_summary is None else self.residual_summary.to_json()
            ),
            "active": [
                {"label": a.label, "kind": a.kind, "parameters": list(a.names),
                 "value": a.value, "multiplier": a.multiplier}
                for a in self.active
            ],
            "prior_share": self.prior_share,
            "faulty_report": (
                None if self.faulty_report is None else self.faulty_report.to_json()
            ),
            "converged": self.converged,
            "backend": self.model.backend_report(),
            "outliers": [vars(o) for o in self.outliers],
            "excluded": [vars(o) for o in self.excluded],
            "warnings": list(self.warnings),
            "findings": [f.to_json() for f in self.findings],
        }  # fmt: skip


def _estimate_json(e: Estimate) -> dict[str, Any]:
    return {
        "name": e.name, "value": e.value, "unit": e.unit,
        "std": None if e.std is None else _finite(e.std),
        "ci95": None if e.ci95 is None else [_finite(v) for v in e.ci95],
        "dof": None if e.dof is None else _finite(e.dof), "identifiable": e.identifiable,
        "combined_with": list(e.combined_with), "nominal": e.nominal, "held": e.held,
        "note": e.note or _endless(e.ci95),
    }  # fmt: skip


def _endless(ci95: tuple[float, float] | None) -> str:
    """Why an end of the interval is null; "" where both are numbers."""
    if ci95 is None:
        return ""
    ends = [name for name, v in zip(("lower", "upper"), ci95, strict=True) if not np.isfinite(v)]
    return f"the data set no {' or '.join(ends)} limit to it" if ends else ""


def _finite(value: float) -> float | None:
    """None for an interval without an end, and for the infinite dof of a normal distribution."""
    return value if np.isfinite(value) else None


def _um(value: float) -> float | None:
    """Metres to µm; None where there is no number (JSON has no infinity)."""
    return value * 1e6 if np.isfinite(value) else None
