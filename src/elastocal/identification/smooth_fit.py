"""The fit of a model with smooth functions: all parameters together, noise judged beside them.

What a model without them leaves is no noise where they are there, so that everything which noise
decides is decided beside them: the size of each function (`smooth_prior`), which ordinary
parameters are worth a column, the noise model, and which readings are faulty.  The last two see
the residual of each configuration in units of what it varies by: with whitened rows, H the hat
matrix of readings and prior, and H_c its block of a configuration,

    cov(e_c) = σ² (1 − H_c)   in the fit,      σ² (1 + H_c)   of one left out,

exactly under the model, the smooth functions as random as their prior says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse, special

from elastocal.engine import Products, climb
from elastocal.identification.knowledge import share_of_prior
from elastocal.identification.least_squares import (
    ALONE,
    Covariance,
    Crossed,
    held_out_by_parts,
    rms_3d,
)
from elastocal.identification.noise_choice import NoiseFit, linearised, weights_of
from elastocal.identification.noise_structure import Readings
from elastocal.identification.outliers import FALSE_ALARM, FEW, drops, settle
from elastocal.identification.solve import (
    WORTH_A_COLUMN,
    Course,
    MethodResult,
    Reduction,
    SmoothPart,
    choose,
    deviates,
    own_size,
)
from elastocal.identification.start import ordinary
from elastocal.identification.weighted_problem import Fit, PriorRows, Problem, RFactor, same_size
from elastocal.identification.weighted_problem import fit as least_squares
from elastocal.messages import listed
from elastocal.model.manipulator import Model, smooth_groups
from elastocal.units import Array, BoolArray, IntArray

# Parameters with a prior beside parameters without one: sizes by restricted likelihood, posterior.
#
#     e = B_f α + B_s b + ε,   ε ~ N(0, σ²),   b ~ N(0, Λ),   Λ = diag(λ_g s²)
#
# with whitened rows; α are the ordinary parameters, b the shrunk ones as deviations from nominal, s
# their standard deviations as declared and λ_g one scale for each group.  With [B_f B_s e] = QR the
# rows are needed no more: R_ss, below what the ordinary parameters take, holds all that decides σ²
# and λ (Patterson and Thompson 1971; Harville 1977).

# Scales λ beyond these are no longer told apart: nothing is left of the group, or of its prior.
LEAST, MOST = 1e-3, 1e6
SMALL = 0.05
# Of log λ above 0: a function may be smaller than stated at no price, but ten times the size costs
# what a likelihood ratio of 1e8 gains.  Data that hardly show a function know no upper limit.
# Parameters of known size pay below 0 as well: where others stand for a few of them too, the
# likelihood has them vanish, and how uncertain they are with them.
PRICE = 0.75
NOISE = 0.1  # as a share of the variance that ordinary parameters leave, at the start of the search
CLIMBS, ENOUGH, CURVED = 30, 1e-3, 0.3  # of −2ℓ: what the last step may promise; its curvature


@dataclass(frozen=True)
class Scales:
    """λ (groups,), σ² of a whitened row, and by how much (groups,) the restricted log-likelihood
    falls where a group is left out."""

    scale: Array
    variance: float
    gain: Array

    @property
    def sigma(self) -> float:
        return float(np.sqrt(self.variance))


@dataclass(frozen=True)
class LinearRows:
    """Rows linearised: the R factor of [B_f B_s e], e at nominal functions.  `std` (shrunk,) are
    the prior's standard deviations as declared, `group` (shrunk,) the numbers of the groups, of
    which the first are `functions`, the others parameters of known size."""

    factor: RFactor
    std: Array
    group: IntArray
    functions: int

    def only(self, kept: IntArray) -> LinearRows:
        """With the ordinary columns `kept` alone: what the others took is the functions' again."""
        chosen = np.append(kept, np.arange(self.ordinary, self.factor.columns))
        return replace(self, factor=self.factor.of_columns(chosen))

    @property
    def ordinary(self) -> int:
        return self.factor.columns - len(self.std)

    @cached_property
    def products(self) -> Products:
        rest = self.factor.augmented[self.ordinary :, self.ordinary :]
        S, left = rest[:, :-1], rest[:, -1]
        spare = max(self.factor.rows - self.ordinary, 1)
        return Products(S.T @ S, S.T @ left, float(left @ left), spare)

    def scales(self, start: Scales | None = None) -> Scales:
        """λ and σ² of the largest restricted likelihood, where λ has its PRICE; what is 0 at the
        `start` stays so."""
        products, n = self.products, int(self.group.max(initial=-1)) + 1
        own = self.group[:, None] == np.arange(n)

        def variances(theta: Array) -> Array:
            return np.exp(2 * theta[1:])[self.group] * self.std**2

        def objective(theta: Array) -> tuple[float, Array, Array]:
            value, slope, information = products.objective(variances(theta), 2.0 * own, theta[0])
            over = 2 * theta[1:] / PRICE
            over[: self.functions] = np.maximum(over[: self.functions], 0.0)
            slope[1:] += 4 * over / PRICE
            # What is next to nothing has next to no curvature: no step may be taken for it.
            information[np.diag_indices_from(information)] += CURVED
            at = 1 + np.flatnonzero(over)
            information[at, at] += 8 / PRICE**2
            return value + float(over @ over), slope, information

        variance = max(products.squares / products.rows, 1e-300)
        start = start or Scales(np.ones(n), NOISE * variance, np.zeros(n))
        least, most = 0.5 * np.log([LEAST, MOST])
        lower = np.append(0.5 * np.log(variance) - 20.0, np.full(n, least))
        upper = np.append(0.5 * np.log(variance) + 1.0, np.full(n, most))
        gone = 1 + np.flatnonzero(start.scale == 0)
        lower[gone], upper[gone] = -np.inf, -np.inf
        # From nothing the likelihood shows no way back: what is small begins anew.
        known = np.where(start.scale < SMALL, 1.0, start.scale)
        begun = np.clip(0.5 * np.log(np.append(start.variance, known)), lower, upper)
        theta = climb(objective, begun, lower, upper, ENOUGH, CLIMBS)[0]
        at = products.at(variances(theta), theta[0])
        gain = at.left_out([np.flatnonzero(mine) for mine in own.T])
        return Scales(np.exp(2 * theta[1:]), float(np.exp(2 * theta[0])), gain)


class Posterior:
    """The estimate under a prior: ordinary columns first, then the shrunk ones that take part.
    `r_factor` is that of readings and prior rows P (own, columns) together, in units of σ, the
    shrunk ones counted from nominal; `own` index those that take part."""

    def __init__(self, linear: LinearRows, scales: Scales) -> None:
        k, std = linear.ordinary, np.sqrt(scales.scale / scales.variance)[linear.group] * linear.std
        self.own = own = np.flatnonzero(std > 0)
        self.P = np.eye(len(own), k + len(own), k) / std[own, None]
        prior = RFactor(np.column_stack([self.P, np.zeros(len(own))]), 0)
        self.r_factor = linear.factor.of_columns(np.append(np.arange(k), k + own)).merged(prior)

    @property
    def step(self) -> Array:
        """α and b (columns,)."""
        return self.r_factor.half @ self.r_factor.projected

    @property
    def marginal(self) -> RFactor:
        """R of the ordinary columns with the shrunk ones taken for noise,
        RᵀR/σ² = B_fᵀ(σ² + B_sΛB_sᵀ)⁻¹B_f."""
        n = len(self.own)
        rows = self.r_factor.of_columns(np.roll(np.arange(self.r_factor.columns), n))
        return RFactor(rows.augmented[n:, n:], rows.rows)

    @cached_property
    def cofactor(self) -> Array:
        return self.r_factor.half @ self.r_factor.half.T

    @property
    def prior_share(self) -> Array:
        return share_of_prior(self.cofactor, self.P)

    @cached_property
    def effective(self) -> Array:
        """How many parameters' worth of each (columns,) the readings determine, 0 to 1."""
        return np.asarray(1 - (self.P**2).sum(axis=0) * np.diag(self.cofactor))


STEPS = 150  # a few do mostly; springs beside weights that no load tells go along a valley
SETTLED = 1e-4  # of a χ²: what the last step may still gain
ROUNDS = 6
# Two readings say the same where what the fit knows of them is that correlated, and their errors
# differ by less than this share of themselves.
SAME_POSE, ALIKE = 0.8, 0.5
STILL = 0.05  # relative change of the noise at which the rounds end
# Logarithms of the likelihood ratio: below the first the readings do not show a function at all,
# above the second no doubt is left that it is there.
LEAST_GAIN, CERTAIN = 0.01, 50.0


class Functions:
    """What of the parameters `free` has a prior: columns (shrunk,), in groups (shrunk,) of one
    scale each: the smooth functions `groups`, then parameters that deviate from nominal by a size
    that is known, to either side, those of an effect at a place that have one unit together.

    A minimal complete set of these, the rest held at nominal, fits the poses measured as well, but
    far from them it goes anywhere: each that is kept stands for all that are not, where these poses
    cannot tell them apart.  None are where nothing would be left without a prior.
    """

    def __init__(self, model: Model, free: IntArray) -> None:
        self.groups = [g for g in smooth_groups(model) if np.isin(g.columns, free).any()]
        columns = [c[np.isin(c, free)] for c in (g.columns.ravel() for g in self.groups)]
        own, alike = ordinary(model, free), dict[tuple[str, str, str], list[int]]()
        sized = own[deviates(model)[own]]
        for c in sized.tolist() if len(sized) < len(own) else ():
            p = model.parameters[c]
            alike.setdefault((p.effect, p.where, p.unit), []).append(c)
        columns += [np.array(same) for same in alike.values()]
        self.group = np.repeat(np.arange(len(columns)), [len(c) for c in columns])
        self.columns = np.concatenate(columns)
        self.std = np.array([model.parameters[c].typical for c in self.columns], dtype=float)
        self.nominal = model.nominal[self.columns]
        self.unsure: Array = np.zeros(len(self.columns))

    def as_large_as(self, fit: JointFit) -> bool:
        """Whether this arm's errors beside the functions are larger than typical (`own_size`): then
        parameters of known size are so from here on, `unsure` (shrunk,) the variance of log size.
        An estimate varies by its prior variance less what is left of that: by the share that the
        readings determine."""
        sized = self.group >= len(self.groups)
        told = fit.posterior.effective[len(fit.reduction.kept) :][sized]
        away = ((fit.found.x[self.columns] - self.nominal) / self.std)[sized]
        own, unsure = own_size(away**2, told)
        self.std, self.unsure = self.std * np.where(sized, own, 1.0), np.where(sized, unsure, 0.0)
        return own > 1


@dataclass(frozen=True)
class JointFit:
    """The minimum of readings and prior together: the ordinary columns that the `reduction` keeps,
    then those of the functions that take part; `linear` is the linear problem there."""

    found: Fit
    reduction: Reduction
    scales: Scales
    linear: LinearRows

    @cached_property
    def posterior(self) -> Posterior:
        return Posterior(self.linear, self.scales)

    def whitened(self, part: Problem) -> tuple[Array, Array]:
        """Q (rows, columns), whose squares are by how much of the noise the fit varies at the
        readings of a part, and their residual (rows,)."""
        B, e = part.whitened(self.found.x, self.found.columns)
        return B @ self.posterior.r_factor.half, e

    def standardised(self, others: Problem | None = None) -> Array:
        """Residuals (N, size) free of the fit's part in them, in m or rad: of the fit's own
        readings, configuration by configuration, or of `others`, which vary by 1 + QQᵀ instead of
        1 − QQᵀ."""
        problem, side = (self.found.problem, -1) if others is None else (others, 1)
        standard = np.empty(len(problem.observations.value))

        def one(part: Problem) -> None:
            (Q, e), own = self.whitened(part), part.observations
            labels = own.configuration if side < 0 else np.arange(len(own.lead))
            for rows in same_size(np.repeat(labels, own.size)):
                gap = np.eye(rows.shape[1]) + side * Q[rows] @ Q[rows].transpose(0, 2, 1)
                values, axes = np.linalg.eigh(gap)
                turned = (e[rows][:, None] @ axes) / np.sqrt(np.maximum(values, ALONE))[:, None]
                e[rows] = (turned @ axes.transpose(0, 2, 1))[:, 0]
            if part.weights.whiten is not None:
                e = sparse.linalg.spsolve(part.weights.whiten.tocsc(), e)
            standard[part.rows] = e

        list(problem.each(one))
        return standard.reshape(-1, problem.observations.size)


def fit_smooth(course: Course) -> MethodResult:
    course.progress("fitting smooth functions")
    search = _Search(course)
    fit, noise, good = search.settled(~course.faulty)
    fit, cross = search.without_those_that_harm(fit)
    return search.result(fit, cross, noise, good)


class _Search:
    def __init__(self, course: Course) -> None:
        self.every, self.options, self.progress = course.every, course.options, course.progress
        every, sound = course.every, course.sound
        self.model, self.observed = every.problem.model, every.problem.observations
        # Functions could follow a shifted block as well, which is no reason to take it back.
        report = course.report() if course.faulty.mean() > FEW else None
        groups = report.blocks(self.observed.table) if report else []
        faulty = np.flatnonzero(course.faulty)
        self.blocks = [np.intersect1d(faulty, g.readings) for g in groups]
        self.shifted = np.isin(np.arange(len(course.faulty)), np.concatenate([[], *self.blocks]))
        self.functions, self.harmful = Functions(self.model, course.free), list[str]()
        own = np.setdiff1d(sound.problem.free, self.functions.columns)
        problem = replace(sound.problem, free=own, sizes=every.problem.sizes)
        self.sound = replace(
            sound, fit=replace(sound.fit, problem=problem), reduction=sound.reduction.among(own)
        )
        self.estimating = self.options.resolved == "reml" and not every.problem.large
        # Labels of each reading, and one column that no residual follows: they have paid for the
        # parameters already.
        bare = linearised(self.model, self.observed, every.fit.x, np.zeros(0, dtype=np.int64))
        column = np.random.default_rng(0).normal(size=(*bare.e.shape, 1))
        visits = None if bare.visits is None else replace(bare.visits, lasting=())
        self.readings: Readings = replace(bare, B=column, visits=visits)
        self.standard = np.zeros(bare.e.shape)  # residuals free of the fit's part in them
        self.alike = np.zeros(len(bare), dtype=bool)  # as readings of other configurations

    def chosen(self, noise: NoiseFit | None, good: BoolArray) -> Problem:
        part = self.every.problem.part(np.flatnonzero(good))
        if noise is not None:
            part = replace(part, weights=weights_of(noise, self.readings.take(good)))
        return part

    def joint(
        self, problem: Problem, x: Array, reduction: Reduction, scales: Scales | None = None, *,
        choosing: bool = True,
    ) -> JointFit:  # fmt: skip
        """The fit to readings and prior from x.  The sizes of the functions are estimated there,
        from `scales` on, and unless `choosing` is False the ordinary parameters are chosen
        beside them, instead of `reduction`.  ElastocalError where the start has poses without
        equilibrium."""
        f, own = self.functions, self.sound.problem
        problem = replace(problem, free=np.append(own.free, f.columns))
        x = reduction.shifted(x, own.x0)
        if scales is not None:
            gone = f.columns[(scales.scale == 0)[f.group]]
            x[gone] = self.model.nominal[gone]
        free = self._rows(problem, x)
        scales = free.only(np.searchsorted(own.free, reduction.kept)).scales(scales)
        if choosing:
            before, marginal = reduction.kept, Posterior(free, scales).marginal
            reduction = choose(own, marginal, scales.sigma, WORTH_A_COLUMN)
            if not np.array_equal(before, reduction.kept):
                x = reduction.shifted(x, own.x0)
                free = self._rows(problem, x)
        reduction = reduction.seen(own.free, free.factor.R, own.sizes)
        kept = np.searchsorted(own.free, reduction.kept)
        prior = Posterior(free.only(kept), scales)
        columns = np.append(reduction.kept, f.columns[prior.own])
        known = PriorRows(prior.P, prior.P @ self.model.nominal[columns])
        found = least_squares(
            problem, columns, x, known=known, max_steps=STEPS,
            tolerance=SETTLED / len(problem.observations.value),
        )  # fmt: skip
        return JointFit(found, reduction, scales, self._rows(problem, found.x).only(kept))

    def _rows(self, problem: Problem, x: Array) -> LinearRows:
        f, factor = self.functions, problem.evaluate(x, problem.free)[1]
        rows, away = factor.augmented.copy(), x[f.columns] - f.nominal
        rows[:, -1] += rows[:, -1 - len(away) : -1] @ away
        return LinearRows(RFactor(rows, factor.rows), f.std, f.group, len(f.groups))

    def crossed(self, fit: JointFit, scales: Scales) -> Crossed:
        """In m or rad, infinite where there is none, with functions of these `scales`."""
        found, f, posterior = fit.found, self.functions, Posterior(fit.linear, scales)
        columns, x = np.append(fit.reduction.kept, f.columns[posterior.own]), found.x.copy()
        x[f.columns] = f.nominal
        x[columns] += posterior.step  # of functions from nominal
        return held_out_by_parts(
            found.problem, found.x, columns, posterior.r_factor.half, x - found.x
        )

    def settled(self, good: BoolArray) -> tuple[JointFit, NoiseFit | None, BoolArray]:
        noise: NoiseFit | None = None
        x, reduction, scales, level = self.sound.fit.x, self.sound.reduction, None, np.inf
        for k in range(ROUNDS):
            fitted = good | (not drops(self.options, self.observed, ~good, lambda: self.shifted))
            part = self.chosen(noise, fitted)
            problem = replace(
                self.sound.problem, observations=part.observations, weights=part.weights
            )
            fit = self.joint(problem, x, reduction, scales)
            x, reduction, scales = fit.found.x, fit.reduction, fit.scales
            still, level = abs(scales.variance / level - 1) < STILL, scales.variance
            self.standard[fitted] = fit.standardised()
            if not fitted.all():
                self.standard[~fitted] = fit.standardised(self.chosen(noise, ~fitted))
            for block in (b for b in self.blocks if self.shifted[b].any() and not fitted[b].any()):
                self.shifted[block] = self.stays_shifted(fit, block)
            before, kind = good, None if noise is None else noise.kind
            noise, good = self.judged(noise, good, k)
            good = self.corroborated(fit, noise, fitted, good) & ~self.shifted
            same = noise is None or noise.kind == kind
            if still and same and np.array_equal(before, good):
                break
            if k == 0 and self.functions.as_large_as(fit):  # and begin anew with these sizes
                scales = replace(scales, scale=np.ones_like(scales.scale))
            if noise is not None:  # in units of which rows are whitened next
                scales = replace(scales, variance=1.0)
                self.progress(f"fitting with the noise found ({noise.kind})")
        return fit, noise, good

    def judged(
        self, noise: NoiseFit | None, good: BoolArray, k: int
    ) -> tuple[NoiseFit | None, BoolArray]:
        if self.estimating:
            # From the second round on, whose fit has such weights, the kind of noise is known.
            known = noise if k > 1 else None
            return settle(replace(self.readings, e=self.standard), self.options.noise, good, known)
        n, size = len(self.standard), self.observed.size
        e = self.every.problem.weights.apply(self.standard.ravel()).reshape(n, size)
        squared, dof = (e**2).sum(axis=1), max(int(good.sum()) * size, 1)
        limit = squared[good].mean() * special.fdtri(size, dof, 1 - FALSE_ALARM / n)
        return None, np.asarray(squared <= limit)

    def stays_shifted(self, fit: JointFit, block: IntArray) -> bool:
        """Whether most of a block's shift is there beside functions that were fitted without it.
        Else the model lacked something where its poses are."""
        part, at = self.every.problem.part(block), (self.sound.fit.x, fit.found.x)
        residuals = (part.whitened(x, fit.found.columns)[1].reshape(len(block), -1) for x in at)
        before, now = (np.linalg.norm(e.mean(axis=0)) for e in residuals)
        return bool(now > before / 2)

    def corroborated(
        self, fit: JointFit, noise: NoiseFit | None, fitted: BoolArray, good: BoolArray
    ) -> BoolArray:
        """The good readings (N,) and those outside the fit of which another configuration says the
        same: two readings at nearly the same pose that err alike, beside a fit without them, are no
        errors of reading.  The model lacks something there, and what it has corrects part of it."""
        suspects = np.flatnonzero(~good & ~fitted)
        if len(suspects) < 2:
            return good | self.alike
        rest = self.chosen(noise, np.isin(np.arange(len(good)), suspects))
        Q = fit.whitened(rest)[0].reshape(len(suspects), -1)
        Q = Q / np.linalg.norm(Q, axis=1, keepdims=True)
        e, own = self.standard[suspects], rest.observations.configuration
        length, apart = np.linalg.norm(e, axis=1), np.linalg.norm(e[:, None] - e[None], axis=2)
        alike = (Q @ Q.T > SAME_POSE) & (apart < ALIKE * np.minimum.outer(length, length))
        alike &= own[:, None] != own[None]
        self.alike[suspects[alike.any(axis=1)]] = True
        return good | self.alike

    def without_those_that_harm(self, fit: JointFit) -> tuple[JointFit, Crossed]:
        """Without the functions that the readings do not show, or that predict held-out
        configurations worse than none; the least supported is tried first."""
        size, scales, cross = self.observed.size, fit.scales, self.crossed(fit, fit.scales)
        for g in np.argsort(scales.gain[: len(self.functions.groups)]):
            if not scales.scale[g] or scales.gain[g] > CERTAIN:
                continue
            every = np.arange(len(scales.scale))
            without = replace(scales, scale=np.where(every == g, 0.0, scales.scale))
            there, shown = self.crossed(fit, without), scales.gain[g] > LEAST_GAIN
            if shown and rms_3d(there[0], size) > rms_3d(cross[0], size):
                continue
            if shown:
                self.harmful.append(self.functions.groups[g].name)
            scales, cross = without, there
        if (scales.scale > 0).all():
            return fit, cross
        found = fit.found
        fit = self.joint(found.problem, found.x, fit.reduction, scales, choosing=False)
        return fit, self.crossed(fit, fit.scales)

    def result(
        self, fit: JointFit, cross: Crossed, noise: NoiseFit | None, good: BoolArray
    ) -> MethodResult:
        posterior, f, r, found = fit.posterior, self.functions, fit.reduction, fit.found
        columns, model, k = found.columns, self.model, len(r.kept)
        problem = replace(found.problem, free=self.sound.problem.free)
        mixing = np.vstack([r.mixing, np.zeros((len(posterior.own), len(r.dropped)))])
        solution = replace(
            self.sound, held=cross, nominal_rms=self.every.nominal_rms,
            fit=replace(found, problem=problem, r_factor=posterior.marginal),
            reduction=replace(r, kept=columns, mixing=mixing, with_prior=f.columns),
        )  # fmt: skip
        effective, share = float(posterior.effective.sum()), posterior.prior_share
        spare = max(len(found.whitened) - effective, 1.0)
        # The noise's variance is known as well as the readings that the fit has left over say, that
        # of the prior as the size of this arm's errors is.
        unsure = np.append(np.full(k, f.unsure.max()), f.unsure[posterior.own])
        dof = 1 / np.maximum((1 - share) ** 2 / spare + 2 * unsure * share**2, 1e-6 / spare)
        dof[:k] = np.minimum(dof[:k], spare)
        text = (
            "of readings and smooth functions together, the functions as random as their sizes "
            "say; assumes the noise model and normal noise"
        )
        matrix = fit.scales.variance * posterior.cofactor
        covariance = Covariance("posterior", (matrix + matrix.T) / 2, dof, text)
        method = self.options.resolved
        if not self.estimating:
            method = "ols" if problem.weights.kind == "none" else "wls"
        shares = zip(columns, share.tolist(), strict=True)
        return MethodResult(
            method, solution, covariance, noise, good, standard=self.standard,
            prior_share={model.names[c]: part for c, part in shares if not model.shrunk[c]},
            effective=round(effective), warnings=self._warnings(fit),
            smooth=self._parts(fit, covariance.matrix),
            beside=(fit.scales.sigma, spare),
        )  # fmt: skip

    def _parts(self, fit: JointFit, covariance: Array) -> tuple[SmoothPart, ...]:
        f, posterior, x = self.functions, fit.posterior, fit.found.x
        paid, observed = np.zeros(len(f.columns)), fit.found.problem.observations
        paid[posterior.own] = posterior.effective[len(fit.reduction.kept) :]
        table = observed.table
        return tuple(
            SmoothPart(
                group, float(fit.scales.scale[g]), float(paid[f.group == g].sum()),
                x[group.columns], np.zeros((group.columns.size,) * 2),
                np.asarray(table.q[:, group.joint] if group.lasting else table.time)[observed.lead]
                if group.follows else np.zeros(0),
            ).refitted(x, fit.found.columns, covariance)
            for g, group in enumerate(f.groups)
        )  # fmt: skip

    def _warnings(self, fit: JointFit) -> tuple[str, ...]:
        scales, told = fit.scales.scale[: len(self.functions.groups)], []
        gone = [g.name for g, s in zip(self.functions.groups, scales, strict=True) if s == 0]
        if unseen := [name for name in gone if name not in self.harmful]:
            told.append(
                f"Beside the rest of the model the readings need no {listed(unseen, 6)}: held at "
                "zero, as if not in [model] effects. Where diagnose named it, the others stand in."
            )
        if self.harmful:
            told.append(
                f"Poses that were not fitted are predicted better without the "
                f"{listed(self.harmful, 6)}: held at zero."
            )
        return tuple(told)
