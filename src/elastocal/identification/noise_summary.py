"""What a result says of the noise: which model, its size, why, whether repeats agree."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from elastocal.cell import Cell
from elastocal.identification.noise_choice import (
    NoiseFit,
    NoiseTest,
    Trial,
    linearised,
    own_noise,
    with_stated_sharing,
)
from elastocal.identification.noise_structure import CONFIGURATION, TURNED
from elastocal.identification.options import MethodResult
from elastocal.identification.outliers import kept_of
from elastocal.identification.residuals import f_test
from elastocal.identification.weighted_problem import (
    inverse_factor,
    stated_by_observation,
    weights_for,
)
from elastocal.measurements import Measurements, numbered
from elastocal.messages import InputError
from elastocal.model.observations import Observations, pure_error
from elastocal.units import Array, IntArray, microns

# What single readings scatter by, whatever the arm does: of repeats, or of markers of one pose.
#
# The flange takes all markers along as one rigid body.  Of k markers that are read in one visit,
# 3k − 6 numbers (1 of two markers) know nothing of where the arm is, and scatter by the instrument
# alone; so do repeats, by the arm's repeatability besides.  Beside the stated noise they say if it
# is stated right, and the rest of the residual, if the model lacks something.

FEWEST = 35  # degrees of freedom, from which a scatter is known to a factor of 1.25 (95 %)
BEYOND = 0.005  # chance that so much scatter has the stated noise
REST = 0.01  # p-value below which the rest of the residual is more than single readings explain
MOST = 20_000  # readings that are looked at
MOST_NUMBERS = 30_000_000  # of B held at once, to weight readings by what they share


@dataclass(frozen=True)
class SingleReadings:
    """Scatter of single readings in units of the stated noise: `ratio`, with `dof` degrees of
    freedom, `by` what, and the p-value `rest` of the rest of the residual being no more."""

    ratio: float
    dof: int
    by: str
    rest: float

    @property
    def above(self) -> bool:
        return self.ratio**2 * self.dof > float(special.chdtri(self.dof, BEYOND))

    @property
    def explains(self) -> bool:
        return self.above and self.rest >= REST


def single_readings(
    observed: Observations, residual: Array, stated: Array, spent: int, repeats: bool = True
) -> SingleReadings | None:
    """From the `residual` (N·3,) of positions, the noise `stated` (N, 3, 3) for each, and how many
    parameters were `spent` on them; None where neither markers nor, if asked, `repeats` tell."""
    n = len(observed.lead)
    if observed.kind != "position" or n > MOST:
        return None
    root = inverse_factor(stated)
    e = np.einsum("nij,nj->ni", root, residual.reshape(n, 3))
    table, lead = observed.table, observed.lead
    visit = numbered(observed.configuration, observed.load, table.repeat[lead])
    square, dof, by = *_of_bodies(observed, root, e, visit), "markers of one pose"
    if dof < FEWEST and repeats:
        square, dof = pure_error(observed.place, e)
        by = "repeats"
    rest = residual.size - spent - dof
    if dof < FEWEST or rest < 1 or square <= 0:
        return None
    p = f_test(max(float((e**2).sum()) - square, 0.0), rest, square, dof)[1]
    return SingleReadings(float(np.sqrt(square / dof)), dof, by, float(p))


def _of_bodies(observed: Observations, root: Array, e: Array, visit: IntArray) -> tuple[float, int]:
    """Sum of squares and degrees of freedom of whitened e (N, 3) off rigid motions of the markers
    of each visit, the markers' own places on the tool being fitted."""
    table, lead = observed.table, observed.lead
    p = np.asarray(table.position)[lead]
    square, dof = 0.0, 0
    order = np.argsort(visit, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(visit[order])) + 1):
        if len(rows) < 2:
            continue
        turn = np.cross(np.eye(3), (p[rows] - p[rows].mean(axis=0))[:, None, :])
        columns = np.concatenate(
            [np.broadcast_to(np.eye(3), turn.shape), turn.transpose(0, 2, 1)], axis=2
        )
        Q, size, _ = np.linalg.svd((root[rows] @ columns).reshape(-1, 6), full_matrices=False)
        Q = Q[:, size > 1e-9 * size.max()]
        own = e[rows].ravel()
        square += float(own @ own - ((Q.T @ own) ** 2).sum())
        dof += len(own) - Q.shape[1]
    markers = len(np.unique(table.marker[lead]))
    return square, dof - max(3 * markers - 6, min(markers - 1, 1))


TOO_LARGE_IN_COMMON = (
    "Configurations scatter {:.2g} times as much as [noise] configuration_um of the cell states: "
    "correct it, for behind noise stated too large a missing effect does not show."
)


def less_in_common(observed: Observations, residual: Array, cell: Cell, spent: int) -> float | None:
    """Scatter of the mean residual of each configuration in units of what the cell states of it;
    None where chance makes it as little, or what is stated is mostly that of single readings.

    The `spent` parameters are taken to have followed these means alone.
    """
    common, stated = cell.noise.configuration, stated_by_observation(observed, cell.tracker)
    if stated is None or not common or observed.kind not in ("position", "pose"):
        return None
    of = numbered(observed.configuration)
    count = np.bincount(of)[:, None]
    mean, own = np.zeros((len(count), 3)), np.zeros((len(count), 3, 3))
    np.add.at(mean, of, residual.reshape(len(of), -1)[:, :3])
    np.add.at(own, of, stated[:, :3, :3])
    own, dof = own / count[:, None] ** 2, mean.size - spent
    if dof < 1 or common**2 < np.trace(own, axis1=1, axis2=2).mean() / 3:
        return None
    e = inverse_factor(own + common**2 * np.eye(3)) @ (mean / count)[..., None]
    square = float((e**2).sum())
    return math.sqrt(square / dof) if square < special.chdtri(dof, 1 - BEYOND) else None


# Lack of fit: do configurations scatter more than repeats of one configuration?


@dataclass(frozen=True)
class LackOfFit:
    """F = (SS_between / dof_between) / (SS_pure / dof_pure), its p-value, and both dofs."""

    F: float
    p: float
    dof_between: int
    dof_pure: int


def lack_of_fit(observed: Observations, whitened: Array, n_parameters: int) -> LackOfFit | None:
    """F-test of the residual between configurations against pure error from repeats.

    Repeats are observations of the same configuration, marker and force.  Within them the
    whitened residual (rows,) scatters by pure error, SS_pure with Σ (repeats − 1) · size degrees
    of freedom; what is left of the residual sum of squares lies between them (Draper and Smith
    1998, section 2.1).  None where nothing is repeated, or no degree of freedom is left.
    """
    residual = whitened.reshape(-1, observed.size)
    pure, dof_pure = pure_error(observed.place, residual)
    dof_between = len(whitened) - n_parameters - dof_pure
    if dof_pure < 1 or dof_between < 1 or pure <= 0:
        return None
    between = max(float((residual**2).sum()) - pure, 0.0)
    F, p = f_test(between, dof_between, pure, dof_pure)
    return LackOfFit(float(F), float(p), dof_between, dof_pure)


# The noise of a result: which model, its size, why, and whether repeats agree.

NUMBERED = re.compile(r"^(marker|configuration) (\d+)")
TOO_LARGE = (
    "the table is too large for a choice among noise models; stated noise, or equal noise "
    "where none is stated, is scaled to the residual"
)


@dataclass(frozen=True)
class NoiseSize:
    """An estimated standard deviation `sigma` in m, or rad where it `turns`, or the `factor` on the
    stated noise.  `part` says what of PARTS it is, "" for single readings, `joints` are those whose
    scatter it is, `relative` is the standard error of σ² over σ²."""

    name: str
    sigma: float | None
    factor: float | None = None
    part: str = ""
    joints: tuple[int, ...] = ()
    turns: bool = False
    relative: float = 0.0

    def agrees_with(self, stated: float) -> bool:
        """Whether it is the `stated` standard deviation within its 99 % interval, that of log σ²;
        a variance whose uncertainty is not known contradicts nothing."""
        if not self.sigma or not stated:
            return False
        off = abs(2 * math.log(self.sigma / stated))
        return not self.relative or off <= float(special.ndtri(0.995)) * self.relative

    def to_json(self) -> dict[str, Any]:
        unit = "sigma_urad" if self.joints and self.turns else "sigma_um"
        size: dict[str, Any] = {"name": self.name, unit: microns(self.sigma)}
        return size if self.factor is None else size | {"factor": self.factor}


LIKELY = 0.5 * float(special.chdtri(1, 0.05))  # nats within which a likelihood has its 95 %


@dataclass(frozen=True)
class Drift:
    """The correlation time of what drifts, as a `share` of the campaign and in `seconds`; None
    where the table has no times, and the order of its rows was taken for that of the visits.
    `ends`: whether the times as likely as 95 % ask for leave out the longest one tried, whose
    likelihood is that of a random walk."""

    share: float
    seconds: float | None
    ends: bool = True


@dataclass(frozen=True)
class Noise:
    """The noise that an identification rests on.

    `kind` and `description` name the weights.  `sigma` (m) is the noise of a reading's component
    where one number says it, `ratio_to_stated` the residual over the stated noise where any was
    stated, and `single` that of repeats or of markers of one pose alone.  `interval_kind` and
    `interval_description` say how intervals follow from it.  Where the noise was estimated there
    are its `sizes` and the models `tried`; `reason` says why this one.
    `tests` are those for joints that settle anew at each visit and for a drift, `drift` says of a
    course in time how long it lasts.
    """

    kind: str
    description: str
    sigma: float | None = None
    ratio_to_stated: float | None = None
    lack_of_fit: LackOfFit | None = None
    interval_kind: str = "classical"
    interval_description: str = ""
    reason: str | None = None
    sizes: tuple[NoiseSize, ...] | None = None
    tried: tuple[Trial, ...] | None = None
    tests: tuple[NoiseTest, ...] = ()
    drift: Drift | None = None
    single: SingleReadings | None = None

    @property
    def estimated(self) -> bool:
        return bool(self.sizes)

    def scatter(self, n_joints: int) -> tuple[Array, float]:
        """What a visit scatters by: joints (joints,) in rad or m, and m on each axis in common."""
        joints, common = np.zeros(n_joints), 0.0
        for size in self.sizes or ():
            if size.joints:
                joints[list(size.joints)] = size.sigma
            elif size.part == CONFIGURATION and size.sigma is not None:
                common = float(np.hypot(common, size.sigma))
        return joints, common

    @property
    def held_out_by(self) -> str:
        """What is left out at a time to judge predictions: whole blocks in time where something
        drifts, since neighbours in time err alike; the error is then that of another day."""
        return "configurations" if self.drift is None else "blocks in time"

    def to_json(self) -> dict[str, Any]:
        """JSON-ready: lengths in µm, and only what is known of a noise that was not estimated."""
        known = {
            "single_readings": self.single,
            "reason": self.reason,
            "variances": self.sizes,
            "tests": self.tests or None,
            "drift": self.drift,
            "tried": self.tried,
        }
        return {
            "kind": self.kind,
            "description": self.description,
            "sigma_um": microns(self.sigma),
            "ratio_to_stated": self.ratio_to_stated,
            "lack_of_fit": self.lack_of_fit,
            "held_out_by": self.held_out_by,
            "intervals": {"kind": self.interval_kind, "description": self.interval_description},
            **{name: value for name, value in known.items() if value is not None},
        }


def noise_of(found: MethodResult, sigma: float) -> tuple[Noise, dict[str, float]]:
    """The noise that a method found, and its parts: mean square 3-D noise (m²) of single
    "readings", and what readings of "visits" share; `sigma` is that of a whitened row.

    Where no noise was estimated, all of the residual is taken for that of single readings.
    """
    solution, estimated = found.solution, found.noise
    problem, residual = solution.problem, solution.fit.residual
    observed, cell, weights = problem.observations, problem.model.cell, problem.weights
    stated, size = stated_by_observation(observed, cell.tracker), observed.size
    spent = found.effective if found.smooth else None
    spent, single = len(solution.fit.columns) if spent is None else spent, None
    if stated is not None and cell.noise.tails is None:
        told = not cell.noise.shared  # else repeats scatter by more than the instrument
        single = single_readings(observed, residual, stated, spent, told)
    whitened = weights.apply(residual)
    if estimated is None:
        squared = residual.reshape(-1, size)[:, :3] ** 2
        spare = len(residual) / max(len(residual) - spent, 1)
        parts = {"readings": float(squared.sum()) / len(squared) * spare}
    else:
        none = np.zeros(0, dtype=np.int64)
        bare = linearised(problem.model, observed, solution.fit.x, none)
        own = own_noise(estimated.fit, bare)[0]
        alone = np.diagonal(own, axis1=1, axis2=2)[:, :3].sum(axis=1).mean()
        visits = sum(variance * d.mean_square(3) for d, variance in estimated.fit.of(bare))
        parts = {"readings": float(alone), "visits": float(visits)}
        if estimated.fit.common.any():
            whitened = (inverse_factor(own) @ residual.reshape(-1, size, 1)).ravel()
    noise = Noise(
        weights.kind, weights.description, sigma=None if weights.absolute else sigma,
        ratio_to_stated=_ratio_to_stated(found, sigma, spent),
        lack_of_fit=lack_of_fit(observed, whitened, spent), single=single,
        interval_kind=found.spread.kind, interval_description=found.spread.description,
        reason=TOO_LARGE if estimated is None and problem.large else None,
    )  # fmt: skip
    return (noise if estimated is None else _estimated(noise, estimated, observed.table)), parts


def _estimated(noise: Noise, found: NoiseFit, table: Measurements) -> Noise:
    fit, own, sigma = found.fit, found.fit.noisy.own, np.sqrt(found.fit.theta).tolist()
    labels = {"marker": table.marker_names, "configuration": table.configuration_labels}

    def label(numbered: re.Match[str]) -> str:
        return f"{numbered[1]} {labels[numbered[1]][int(numbered[2])]}"

    structure, sizes = fit.noisy.structure, list[NoiseSize]()
    kind = fit.kind.own
    error = np.sqrt(np.diagonal(fit.covariance)) / np.maximum(fit.theta, 1e-300)
    for name, s, r in zip(structure.names, sigma[:own], error[:own].tolist(), strict=True):
        size, factor = (None, s) if kind == "stated" else (s, None)
        name = NUMBERED.sub(label, name)
        sizes.append(NoiseSize(name, size, factor, turns=name in TURNED, relative=r))
    for d, s, r in zip(fit.noisy.deviations, sigma[own:], error[own:].tolist(), strict=True):
        sizes.append(NoiseSize(d.name, s, None, d.part, d.joints, d.turns, r))
    drift, record = None, fit.noisy.readings.visits
    if fit.lasting is not None and record is not None:
        seconds = fit.lasting * record.span if record.timed else None
        drift = Drift(fit.lasting, seconds, found.to_longest > LIKELY)
    return replace(
        noise, kind=found.kind, description=found.description, reason=found.reason,
        sigma=sigma[0] if kind == "independent" and own == 1 else None, sizes=tuple(sizes),
        tried=found.trials, tests=found.tests, drift=drift,
    )  # fmt: skip


def _ratio_to_stated(found: MethodResult, sigma: float, spent: int) -> float | None:
    """Root mean square of the residual in units of the stated noise, per degree of freedom; of
    stated tails, in units of what is left of that noise where far readings are set apart.

    Readings that share some of it are weighted as they share it, and what the parameters take of
    the residual at these weights is taken: only then does it have the expectation 1.
    """
    solution = found.solution
    problem, fit = solution.problem, solution.fit
    observed, model, unit = problem.observations, problem.model, 1.0
    noise = model.cell.noise
    if noise.tails is not None and not found.good.all():
        unit = kept_of(noise.tails, len(found.good) * observed.size, observed.size).sigma
    shared = noise.shared and len(fit.residual) * len(fit.columns) <= MOST_NUMBERS
    if found.method == "wls" and problem.weights.absolute and not shared:
        return sigma / unit
    try:
        stated = weights_for(observed, model.cell.tracker)
    except InputError:
        return None
    if not stated.absolute:
        return None
    if shared and stated.whiten is not None:
        stated = replace(stated, whiten=stated.whiten / unit)
        stated, unit = with_stated_sharing(stated, model, observed, fit.x), 1.0
    e = stated.apply(fit.residual)
    if shared:
        Q, _ = np.linalg.qr(stated.apply(fit.B))
        e = e - Q @ (Q.T @ e)
    return float(np.sqrt(e @ e / max(len(e) - spent, 1))) / unit
