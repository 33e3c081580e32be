"""The calibrated arm before any further effect: its readings in blocks that share noise."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.least_squares import TOLERANCE
from elastocal.identification.solve import PLACING, is_placed, posed, tied_fit, with_placed
from elastocal.identification.start import start_values
from elastocal.identification.weighted_problem import stated_by_observation, weights_for
from elastocal.measurements import Measurements, load_states, numbered, visits
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, observe
from elastocal.units import Array, IntArray


@dataclass(frozen=True)
class Blocks:
    """N observations of `size` components in C blocks of M places, padded where a block is short.

    `member` (C, M) is the observation at each place, N where there is none; `visit` (N,) numbers
    the times that the arm was sent to a pose (configuration, repeat and load state).
    """

    member: IntArray
    visit: IntArray
    size: int

    @classmethod
    def of(cls, configuration: IntArray, visit: IntArray, size: int) -> Blocks:
        """Blocks by `configuration` (N,), in the order of its codes."""
        _, code, count = np.unique(configuration, return_inverse=True, return_counts=True)
        order = np.argsort(code, kind="stable")
        start = np.concatenate([[0], np.cumsum(count)])[code[order]]
        member = np.full((len(count), int(count.max())), len(configuration), dtype=np.int64)
        member[code[order], np.arange(len(order)) - start] = order
        return cls(member, visit, size)

    @property
    def n(self) -> int:
        return len(self.visit)

    @cached_property
    def in_visit(self) -> Array:
        """Which rows belong to each visit (C, m, v), as ones and zeros."""
        visit = np.append(self.visit, -1)[self.member]
        local = np.full(visit.shape, -1)
        for c, row in enumerate(visit.tolist()):
            number = {v: k for k, v in enumerate(dict.fromkeys(v for v in row if v >= 0))}
            local[c] = [number.get(v, -1) for v in row]
        one_hot = (local[:, :, None] == np.arange(max(local.max() + 1, 1))).astype(float)
        return np.repeat(one_hot, self.size, axis=1)

    @cached_property
    def example(self) -> IntArray:
        """An observation of each visit (C, v), −1 where a block has fewer visits."""
        one_hot = self.in_visit[:, :: self.size]
        first = np.take_along_axis(self.member, one_hot.argmax(axis=1), axis=1)
        return np.where(one_hot.any(axis=1), first, -1)

    def of_visits(self, values: Array) -> Array:
        """Per observation (N, …) → per visit (C, v, …), zero where there is none."""
        out = values[np.maximum(self.example, 0)]
        out[self.example < 0] = 0.0
        return out

    def pack(self, rows: Array) -> Array:
        """(N, size, k) → (C, M·size, k), zeros where there is no observation."""
        (C, M), k = self.member.shape, rows.shape[2]
        padded = np.concatenate([rows, np.zeros((1, self.size, k))])
        return padded[self.member].reshape(C, M * self.size, k)

    def unpack(self, packed: Array) -> Array:
        """(C, M·size, k) → (N, size, k)."""
        C, M = self.member.shape
        rows = np.empty((self.n + 1, self.size, packed.shape[2]))
        rows[self.member.ravel()] = packed.reshape(C * M, self.size, packed.shape[2])
        return rows[:-1]

    def pack_square(self, blocks: Array) -> Array:
        """Covariances (N, size, size) of single observations → (C, M·size, M·size)."""
        C, M = self.member.shape
        padded = np.concatenate([blocks, np.zeros((1, self.size, self.size))])[self.member]
        out = np.zeros((C, M, self.size, M, self.size))
        place = np.arange(M)
        out[:, place, :, place, :] = padded.transpose(1, 0, 2, 3)
        return out.reshape(C, M * self.size, M * self.size)

    def unpack_square(self, packed: Array) -> Array:
        """Diagonal blocks (N, size, size) of (C, M·size, M·size)."""
        C, M = self.member.shape
        place = np.arange(M)
        own = packed.reshape(C, M, self.size, M, self.size)[:, place, :, place, :]
        rows = np.empty((self.n + 1, self.size, self.size))
        rows[self.member.T.ravel()] = own.reshape(M * C, self.size, self.size)
        return rows[:-1]

    @property
    def absent(self) -> NDArray[np.bool_]:
        """Rows (C, M·size) that hold no observation."""
        return np.repeat(self.member == self.n, self.size, axis=1)


@dataclass(frozen=True)
class Baseline:
    """The cell's own model fitted to the table, all parameters weakly tied to their start.

    `x` (parameters,) is the fit, `sizes` typical deviations, `nominal` (rows,) the residual of
    the nominal arm with only base and markers placed, NaN where the fit began elsewhere.
    `stated` (N, size, size) is the noise that cell or table state, None where they state none.
    The last `planned` of the N observations are candidates not yet measured: their residual is
    zero and says nothing about what may be at work.
    """

    model: Model
    observed: Observations
    x: Array
    sizes: Array
    residual: Array
    nominal: Array
    stated: Array | None
    planned: int = 0

    @property
    def covariance(self) -> Array:
        """The noise (N, size, size) that is stated; else only its shape, the residual's variances
        along the axes."""
        if self.stated is not None:
            return self.stated
        each = self.residual.reshape(-1, self.observed.size)
        return np.tile(np.diag(np.maximum(each.var(axis=0), 1e-18)), (len(each), 1, 1))

    @property
    def n_measured(self) -> int:
        """Observations that were measured; they come first."""
        return len(self.observed.lead) - self.planned

    @property
    def blocks(self) -> Blocks:
        """Readings by configuration; a visit is a configuration, repeat and load state."""
        table, lead = self.observed.table, self.observed.lead
        return Blocks.of(table.configuration[lead], visits(table)[lead], self.observed.size)


def fit_baseline(
    model: Model, table: Measurements, seed: int = 0, x0: Array | None = None
) -> Baseline:
    """Fit the cell's own effects; every parameter stays, held by a weak tie where data do not.

    `x0` (parameters,) spares the search for a start.
    """
    observed = observe(table, model.observe)
    free = np.arange(len(model.parameters))
    weights = weights_for(observed, model.cell.tracker, "auto")
    nominal = np.full(len(observed.value), np.nan)
    begun = start_values(model, table, seed) if x0 is None else x0
    problem = posed(model, observed, weights, begun, free)
    if x0 is None:
        problem, nominal = with_placed(problem, PLACING)
    found = tied_fit(problem, TOLERANCE)
    stated = stated_by_observation(observed, model.cell.tracker)
    return Baseline(model, observed, found.x, problem.sizes, found.residual, nominal, stated)


# Prior standard deviations of the fitted parameters about the fit, in typical sizes: wide enough
# to leave them to the data, narrow enough that what no reading shows stays where it is.
FITTED, FITTED_COMPLIANCE = 5.0, 1.0
# m or rad: base and markers.  The fit has placed them, but an error that it took for another
# geometry may have moved them by as much; the true effect must be free to bring them back.
PLACED = 0.1


def from_centre(base: Baseline) -> Array:
    """How far (parameters,) the fit is from the centre of the prior: nominal, but for what
    registration placed, which is where it is.

    An unmodelled effect bends parameters that little else holds; they must be free to return.
    """
    return np.where(is_placed(base.model), 0.0, base.x - base.model.nominal)


def prior_deviations(base: Baseline) -> Array:
    """Prior standard deviation (parameters,) of each fitted parameter.

    At least how far the fit has moved it.  Where a prior is narrower than what the readings say,
    an addition with the same columns spares the fitted parameter a part of the way, and is
    believed for that alone: half of v in each of two columns costs v²/4w² less than v in one.
    """
    compliant = [effect_of(p.effect).sized_by_value for p in base.model.parameters]
    wide = base.sizes * np.where(compliant, FITTED_COMPLIANCE, FITTED)
    wide = np.maximum(wide, np.abs(from_centre(base)))
    return np.where(is_placed(base.model), PLACED, wide)


# Large tables are looked at in part: what more readings would add is time and memory.

# Evidence grows with the readings, and an effect worth finding has hundreds of nats in so many.
MOST_ROWS = 12_000
# The same of poses: curves and fields have a thousand columns.  Identified from all poses, a cell
# that was found from half of 3000 predicts others within 1 % as well as one found from all (UR10).
MOST_CONFIGURATIONS = 2_000
# Within one configuration noise is dense: its cost grows with the square of what it holds.
MOST_IN_ONE = 60


def thinned(table: Measurements, most_rows: int = MOST_ROWS) -> tuple[Measurements, str | None]:
    """The table, or a part of it that is large enough, and what was left out.

    Of each configuration the first readings of every marker under every load, as many of each as
    leave MOST_IN_ONE in it; of too many configurations those evenly spaced in the order they were
    measured, so that whatever changes with time still does.
    """
    kind = numbered(table.configuration, load_states(table.force), table.marker)
    order, at = np.argsort(kind, kind="stable"), numbered(table.configuration)
    rank = np.empty(len(table), dtype=np.int64)
    rank[order] = np.arange(len(table)) - np.searchsorted(kind[order], kind[order])
    n_kinds = np.bincount(at[np.unique(kind, return_index=True)[1]])
    part = table.take(rank < np.maximum(MOST_IN_ONE // n_kinds, 1)[at])
    labels, first, rows = np.unique(part.configuration, return_index=True, return_counts=True)
    order = labels[np.argsort(first)]
    wanted = min(int(most_rows / rows.mean()), MOST_CONFIGURATIONS)
    if len(order) > wanted:
        chosen = order[np.linspace(0, len(order) - 1, wanted).round().astype(int)]
        part = part.take(np.isin(part.configuration, chosen))
    if len(part) == len(table):
        return table, None
    return part, (
        f"the table is large: {len(part)} of {len(table)} rows were looked at, from "
        f"{min(len(order), wanted)} of {len(order)} configurations, evenly spaced"
    )


# Models that are derived from another one, kept for as long as that one is.

MOST = 12  # models that are kept of each; those asked for last


def made_once(model: Model, key: Hashable, make: Callable[[], Model]) -> Model:
    """What `make` derives from the model, or what it derived under the same `key` before.

    A diagnosis comes back to the same few models, and to write and differentiate an arm takes
    longer than to evaluate it at sixty poses.
    """
    known: dict[Hashable, Model] = vars(model).setdefault("_derived", {})
    known[key] = known.pop(key) if key in known else make()
    while len(known) > MOST:
        known.pop(next(iter(known)))
    return known[key]
