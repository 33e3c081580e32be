"""The noise floor by repeats, near-repeats and neighbours; errors of what is left out of the fit;
faulty readings, each judged against all others before anything is blamed on the arm."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy  # whose `ndimage` and `sparse.csgraph` load where they are used
from scipy import linalg, sparse, special

from elastocal.diagnosis.baseline import (
    JOINT_SPREAD,
    REPEATABILITY,
    REPEATABILITY_SPREAD,
    STATED_SPREAD,
    NoiseValues,
    NoisyData,
    Projection,
    prior_deviations,
    project,
)
from elastocal.diagnosis.diagnosis import (
    FaultyReading,
    Interval,
    Location,
    NearRepeats,
    NoiseFloor,
    StructureTest,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.identification.identify import left_out
from elastocal.identification.noise_choice import SEVERAL, linearised
from elastocal.identification.noise_structure import JOINTS
from elastocal.identification.noise_summary import BEYOND, single_readings
from elastocal.identification.outliers import FEW, follow_poses, settle
from elastocal.identification.scrutiny import BudgetStep, resampled_rms, stage_of
from elastocal.measurements import numbered, rounded_joints
from elastocal.messages import ElastocalError
from elastocal.model.effects.geometry import BaseFrame
from elastocal.model.evaluate import row_blocks
from elastocal.model.observations import pure_error, subset
from elastocal.units import Array, BoolArray, IntArray


def _left_over(data: NoisyData, at: Projection) -> Array:
    """r − Xβ̂ (N, size) of each observation."""
    return data.blocks.unpack((data.r - data.X @ at.beta)[..., None])[:, :, 0]


def repeats(dataset: DiagnosisData, come_back: bool = False) -> tuple[float, int]:
    """Sum of squares (m²) per axis among repeats of pose, load and marker, and degrees of freedom.
    `come_back`: of those for which the arm was elsewhere in between, in the order of times or rows.
    Readings one after the other, the arm standing still, show the tracker's noise alone."""
    good, observed = ~dataset.data.faulty, dataset.base.observed
    values = observed.value.reshape(-1, observed.size)[good][:, : min(observed.size, 3)]
    group = observed.place[good]
    if come_back:
        order = np.argsort(dataset.moment[good], kind="stable")
        moved = np.diff(dataset.table.configuration[dataset.lead[good]][order], prepend=-1) != 0
        stay = np.empty(len(order), dtype=np.int64)
        stay[order] = np.cumsum(moved)
        first = np.unique(np.column_stack([group, stay]), axis=0, return_index=True)[1]
        group, values = group[first], values[first]
    return pure_error(group, values)


# Two readings i, j whose joints all differ by less than NEAR see the same arm.  A Gaussian process
# of length ℓ and variance A² (squared exponential) has half the mean square difference
#
#     γ(d) = A² (1 − exp(−d²/2ℓ²)),
#
# 0.5 % of A² at d = NEAR and ℓ = 10 NEAR = 0.05 rad, half the length of the roughest error curve
# of a joint that is common; the fitted model's own difference is subtracted.  What is rougher
# only makes the scatter larger: near-repeats bound the noise from above.

NEAR = 5e-3  # rad, or m
SOON = 0.1  # share of the campaign within which two visits follow each other soon
ENOUGH_PAIRS = 8  # that are stated by themselves
DISTANCES = 2**16  # between points that are looked at together


def near_repeats(dataset: DiagnosisData, data: NoisyData, at: Projection) -> NearRepeats | None:
    """Scatter in m per axis among near-repeats, beside the model of `data` at `at`; None without:
    half the mean square of e_i − e_j over pairs of nearest neighbours, e = r − Xβ̂."""
    pairs = near_pairs(dataset, ~data.faulty)
    if not len(pairs):
        return None
    e = _left_over(data, at)[:, :3]
    squares = ((e[pairs[:, 0]] - e[pairs[:, 1]]) ** 2).mean(axis=1) / 2
    moment = dataset.moment
    apart = np.abs(moment[pairs[:, 0]] - moment[pairs[:, 1]]) > SOON * np.ptp(moment)

    def scatter(chosen: BoolArray) -> float | None:
        if min(chosen.sum(), (~chosen).sum()) < ENOUGH_PAIRS:
            return None
        return float(np.sqrt(squares[chosen].mean()))

    # Of a group of k that hang together k − 1 differences do not follow from each other.
    known, at_ends = np.unique(pairs, return_inverse=True)
    n, ends = len(known), at_ends.reshape(pairs.shape).T
    links = sparse.csr_array((np.ones(len(pairs)), tuple(ends)), (n, n))
    independent = n - int(sparse.csgraph.connected_components(links)[0])
    of_all = float(np.sqrt(squares.mean()))
    return NearRepeats(of_all, len(pairs), independent, scatter(~apart), scatter(apart))


def near_pairs(dataset: DiagnosisData, good: BoolArray) -> IntArray:
    """Pairs (k, 2) of `good` (N,) observations of one marker and load in different configurations,
    each with its nearest neighbour in the joints, all within NEAR."""
    table, lead = dataset.table, dataset.lead
    kind = numbered(table.marker[lead], dataset.base.observed.load)
    # One reading of each configuration: the others are repeats.
    same, some = np.column_stack([table.configuration[lead], kind]), np.flatnonzero(good)
    some = some[np.unique(same[some], axis=0, return_index=True)[1]]
    # Of another marker or load no reading is near.
    of_kind = [some[kind[some] == k] for k in np.unique(kind[some])]
    near = [mine[nearest(table.q[lead[mine]], np.inf, NEAR)] for mine in of_kind]
    return _unordered(np.concatenate([np.zeros((0, 2), dtype=np.int64), *near]))


def nearest(x: Array, norm: float = 2.0, within: float = np.inf) -> IntArray:
    """Points of x (n, d) beside the nearest other one (k, 2), where that is `within` a distance.
    By all distances: what finds neighbours among millions takes longer to load."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for block in row_blocks(len(x), DISTANCES // len(x)):
        own = np.arange(block.start, block.stop)
        apart = np.linalg.norm(x[own, None] - x, norm, axis=2)
        apart[own - block.start, own] = np.inf
        near = apart.min(axis=1) <= within
        pairs.append(np.column_stack([own, apart.argmin(axis=1)])[near])
    return np.concatenate(pairs)


def _unordered(pairs: IntArray) -> IntArray:
    return np.unique(np.sort(pairs, axis=1), axis=0)


# Scatter of a joint that goes with pose or time is no scatter.
#
# The best estimate of joint j's deviation in configuration c is in proportion to
# z = gᵀPr / √(gᵀPg), standard normal under the noise model and independent from configuration to
# configuration.  Neighbours in the order of an angle q_k, in the order of measuring, and nearest in
# all joints then have no correlation: √n ρ̂ ~ N(0, 1).  Where they have, ρ̂ is the share of z that is
# a function of what they are neighbours in (one less the nugget of its semivariogram over the
# sill), or less where neighbours are far; and ρ̂ / (gᵀPg) the variance of the deviation that is.

FEWEST_NEIGHBOURS = 30  # configurations, from which the normal approximation holds
FALSE_SMOOTH = 0.01  # chance that any joint of an arm whose joints only scatter seems smooth


def smooth_scatter(dataset: DiagnosisData, data: NoisyData, at: Projection) -> Array:
    """Variance (joints,) in rad² or m² of each joint's deviation that neighbours share.  Functions
    of several angles add up; what goes with all joints or with the order holds them."""
    G = data.masked(data.G)
    J = G.shape[2]
    out = np.zeros(J)
    first = dataset.lead[dataset.blocks.member[:, 0]]
    q, moment = dataset.table.q[first], dataset.moment[dataset.blocks.member[:, 0]]
    limit = -float(special.ndtri(FALSE_SMOOTH / (J * (J + 2))))
    h = np.einsum("cmj,cmj->cj", G, at.P @ G)
    a = np.einsum("cmj,cm->cj", G, at.u)
    for j in range(J):
        known = np.flatnonzero(h[:, j] > 1e-9 * h[:, j].max(initial=1e-300))
        if len(known) < FEWEST_NEIGHBOURS:
            continue
        z = a[known, j] / np.sqrt(h[known, j])
        pairs = [*(_next_to(q[known, k]) for k in range(J)), _next_to(moment[known])]
        scaled = q[known] / np.maximum(q[known].std(axis=0), 1e-12)
        one, other = _unordered(nearest(scaled)).T
        pairs.append((one, other))
        rho = np.array([(z[i] * z[k]).mean() for i, k in pairs])
        rho /= max(float((z**2).mean()), 1e-300)
        rho[rho * np.sqrt([len(i) for i, _ in pairs]) <= limit] = 0.0  # no more than chance
        share = min(max(float(rho[:J].sum()), float(rho[J:].max())), 1.0)
        out[j] = share * float((z**2).mean()) / float(h[known, j].mean())
    return out


def _next_to(x: Array) -> tuple[IntArray, IntArray]:
    """Neighbours in the order of x (n,); among equal ones they are drawn."""
    drawn = np.random.default_rng(len(x)).permutation(len(x))
    order = drawn[np.argsort(x[drawn], kind="stable")]
    return order[:-1], order[1:]


# The floor that is supported: by repeats where there are some, else by what neighbours do not share
# and joints and instruments may have.  The rest of what the fit takes for noise is unexplained.

CONTRADICTED = 0.05  # chance of repeats that scatter so little if the fitted noise were noise
# What the prior of the noise exceeds in 2.5 % of cases: the scatter of a joint (rad, or m), and
# the instrument's over the stated one.  Beyond them only repeats show that scatter is noise, and
# markers of one pose that it is the instrument's.
UPPER = 1.96
MOST_SCATTER = REPEATABILITY * float(np.exp(UPPER * np.hypot(REPEATABILITY_SPREAD, JOINT_SPREAD)))
MOST_STATED = float(np.exp(UPPER * STATED_SPREAD))


def scatter_beyond(noise: NoiseValues, rounding: float = 0.0) -> Array:
    """Variance (joints,) of each joint's scatter beyond what the others let expect, and beyond
    twice what `rounding` gives their values.  The logarithms
    of scatter spread by JOINT_SPREAD about a mean that is REPEATABILITY's within its own spread, so
    that the others tell what one is to be expected of; beyond its limit any joint of an arm is with
    a chance of FALSE_SMOOTH."""
    J, usual = len(noise.joint), np.log(REPEATABILITY)
    off = np.log(noise.joint) - usual
    known = (J - 1) / JOINT_SPREAD**2 + 1 / REPEATABILITY_SPREAD**2
    others = (off.sum() - off) / JOINT_SPREAD**2 / known
    spread = np.sqrt(JOINT_SPREAD**2 + 1 / known)
    limit = np.exp(usual + others - float(special.ndtri(FALSE_SMOOTH / J)) * spread)
    scatter = noise.joint**2 * (1 + noise.shared**2)
    limit = np.maximum(np.minimum(limit, MOST_SCATTER), 2 * rounding)
    return np.maximum(scatter - limit**2, 0.0)


class SupportedFloor:
    """How much of the fitted noise is noise: 3-D rms (m) that is `noise`, and the rest of it, which
    is `unexplained`; the mean squares (m²) of it that each of the `joints` and the `instrument`
    has.  `stands_out`: whether a joint scatters more than the others let expect.

    `best` (m) is the smallest error left at held-out poses, which no noise exceeds.  Repeats and
    near-repeats together (ν degrees of freedom, mean square s²) contradict the fitted variance σ²
    where νs²/σ² is below the χ² quantile; they are then the floor themselves, with what
    is stated as common to a configuration, which its repeats do not show."""

    def __init__(
        self, dataset: DiagnosisData, data: NoisyData, noise: NoiseValues, best: float
    ) -> None:
        self.of, self.at = (dataset, data, noise), project(data, noise)
        fitted = min(noise_rms(data, noise), best)
        size = min(data.blocks.size, 3)
        scatter = noise.joint**2 * (1 + noise.shared**2)
        smooth = np.minimum(smooth_scatter(dataset, data, self.at), scatter)
        above, excess = 0.0, np.zeros_like(scatter)
        if data.stated:  # else what joints do and what the instrument does are not to be told apart
            rounding = rounded_joints(dataset.table, dataset.base.model.chain.turning)
            excess = scatter_beyond(noise, rounding[0] if rounding else 0.0)
            smooth = np.maximum(smooth, excess)
            above = max(noise.factor**2 - max(MOST_STATED, self._of_single_readings()) ** 2, 0.0)
        stated = np.sqrt(np.diagonal(data.covariance, axis1=1, axis2=2))
        moved = np.moveaxis(data.G * np.sqrt(smooth), 2, 0)
        self.joints = np.array([mean_square(data, g) for g in moved])
        self.instrument = above * (reading := mean_square(data, stated))
        # However much the joints would scatter, readings have their own noise.
        own = noise.factor**2 * reading - self.instrument
        variance = max(fitted**2 - self.joints.sum() - self.instrument, own)
        total, dof = repeats(dataset, come_back=True)
        self.near_repeats, alike = near_repeats(dataset, data, self.at), dataset.common**2
        common = min(size * alike, variance)
        if near := self.near_repeats:
            total += max(near.scatter**2 - alike, 0.0) * near.independent * size
            dof += near.independent * size
        if dof:
            shown = size * total / dof
            low = float(special.chdtri(dof, 1 - CONTRADICTED)) / dof
            high = float(special.chdtri(dof, CONTRADICTED)) / dof
            if shown < low * (fitted**2 - common) or shown > high * (variance - common):
                variance = shown + common
        self.noise, self.stands_out = min(float(np.sqrt(variance)), fitted), bool(excess.any())
        self.unexplained = float(np.sqrt(max(fitted**2 - self.noise**2, 0.0)))

    def _of_single_readings(self) -> float:
        """How many times the stated noise markers of one pose, or repeats, let the instrument have:
        the upper end of what they show; 0 where they do not tell."""
        (dataset, data, _), good = self.of, ~self.of[1].faulty
        base, e = dataset.base, _left_over(data, self.at)[good].ravel()
        assert base.stated is not None
        some = subset(base.observed, good)
        found = single_readings(some, e, base.stated[good], data.X.shape[2])
        if found is None:
            return 0.0
        return found.ratio * float(np.sqrt(found.dof / special.chdtri(found.dof, 1 - BEYOND)))

    @property
    def told(self) -> NoiseFloor:
        (square, dof), (dataset, data, noise) = repeats(self.of[0]), self.of
        variance = np.diagonal(data.covariance, axis1=1, axis2=2)
        ratio = noise_rms(data, noise) / np.sqrt(mean_square(data, np.sqrt(variance)))
        # Those left out have their error against the fit to the others.
        e, stated = _left_over(data, self.at), data.blocks.unpack(variance[..., None])[:, :, 0]
        sigma, variance = noise.factor * np.sqrt(stated), variance[~data.left_out]
        # What visits of a configuration have in common shows where there are several.
        several = data.blocks.in_visit.shape[2] > 1
        joint = noise.joint if several else noise.joint * np.hypot(1.0, noise.shared)
        table, gone = dataset.table, np.flatnonzero(data.faulty)
        faulty = tuple(
            FaultyReading(
                int(table.row[row]), table.configuration_labels[table.configuration[row]],
                table.marker_names[table.marker[row]],
                float(np.linalg.norm(e[k, :3])), float(np.linalg.norm(e[k] / sigma[k])),
            )
            for k, row in zip(gone, dataset.lead[gone], strict=True)
        )  # fmt: skip
        return NoiseFloor(
            data.stated, noise.factor, float(ratio), float(noise.factor * np.sqrt(variance.mean())),
            tuple(joint.tolist()), noise.shared_by_all * several,
            float(np.sqrt(square / dof)) if dof else None,
            tuple((noise.shared * several).tolist()), faulty, self.near_repeats, dataset.drift,
            dataset.common,
        )  # fmt: skip

    @property
    def open(self) -> bool:
        """Whether more is unexplained than is noise, or a joint stands out and repeats do not."""
        return self.unexplained > (0.0 if self.stands_out else self.noise)

    def location(self, tests: Sequence[StructureTest]) -> Location | None:
        """Where what is unexplained lies, each joint by its share; None where not in joints."""
        if self.joints.sum() <= self.instrument:
            return None
        share = self.joints / (self.joints.sum() + self.instrument)
        places = {f"joint{j + 1}": float(p) for j, p in enumerate(share) if p > 0}
        where = max(places, key=lambda name: places[name])
        return Location.of(
            "transmission", where, {"transmission": float(share.sum())}, places, tests
        )


def noise_rms(data: NoisyData, noise: NoiseValues) -> float:
    """3-D rms in m that the noise alone gives a reading."""
    variance = np.diagonal(data.V(noise), axis1=1, axis2=2)
    return float(np.sqrt(mean_square(data, np.sqrt(variance))))


def mean_square(data: NoisyData, packed: Array) -> float:
    """Mean over the readings of the squared 3-D length of `packed` (C, m)."""
    squares, count = squared_lengths(data, packed)
    return float(squares.sum() / count.sum())


def left_out_residual(at: Projection, together: IntArray | None = None) -> Array:
    """r_c − X_c β̂₋c = P_cc⁻¹ u_c (C, m): each configuration under the fit to the others.
    `together` (C,) numbers the group that each is left out with; by itself where None.  For a
    group, with V and H of its configurations, P⁻¹u = V u + V H (I − HᵀVH)⁻¹ HᵀV u."""
    if together is None:
        return each_left_out(at.P, at.u)
    Vu, VH = (np.linalg.solve(at.inverse, b) for b in (at.u[..., None], at.H))
    out = Vu[..., 0]
    for g in np.unique(together):
        own = together == g
        H = at.H[own]
        inner = np.eye(H.shape[2]) - np.einsum("cmp,cmq->pq", H, VH[own])
        z = np.linalg.solve(inner, np.einsum("cmp,cm->p", H, Vu[own, :, 0]))
        out[own] += VH[own] @ z
    return np.asarray(out)


def each_left_out(P: Array, u: Array) -> Array:
    """The same of each configuration by itself, from P (C, m, m) and u (C, m)."""
    return np.asarray(np.linalg.solve(P, u[..., None])[..., 0])


def squared_lengths(data: NoisyData, packed: Array) -> tuple[Array, Array]:
    """Per configuration: Σ of squared 3-D lengths of `packed` (C, m), and the number of readings.
    Of a pose the position counts, of a distance its one component."""
    C, M = data.blocks.member.shape
    size = data.blocks.size
    used = ~data.left_out.reshape(C, M, size)[:, :, 0]
    part = packed.reshape(C, M, size)[:, :, : min(size, 3)]
    return ((part**2).sum(axis=2) * used).sum(axis=1), used.sum(axis=1)


def left_out_square(data: NoisyData, noise: NoiseValues, together: IntArray | None = None) -> float:
    """Mean square (m²) of the 3-D error of a reading whose configuration was left out."""
    return mean_square(data, left_out_residual(project(data, noise), together))


NEW_POSES = 100  # in the set that the intervals of a reduction are for


def rms_with_interval(
    data: NoisyData, packed: Array, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """3-D rms in m of residuals (C, m) and its 95 % interval by resampling configurations."""
    return resampled_rms(*squared_lengths(data, packed), rng)


SPARE = 10  # rows


def first_steps(
    dataset: DiagnosisData, noise: NoiseValues, rng: np.random.Generator
) -> list[BudgetStep]:
    """The nominal arm, base and markers placed as the baseline left it, and the fitted effects.  By
    the weights of an ordinary calibration: scatter of joints that is fitted beside a missing effect
    is that effect, and weights by it would spare it.  Where there are no SPARE rows to a parameter,
    what is held of those hardly shown decides, and `identify` says it."""
    base, data, blocks = dataset.base, dataset.data, dataset.blocks
    rows, good = base.nominal.reshape(-1, blocks.size, 1).copy(), ~data.faulty
    steps = [BudgetStep(BaseFrame.name, *rms_with_interval(data, blocks.pack(rows)[:, :, 0], rng))]
    # Stage by stage, effects of the later step held at nominal, in the columns of the others too:
    # what moves the load would else pass for the compliances under it.
    effects = {p.name: p.effect for p in base.model.parameters}
    stage = np.array([stage_of(effects.get(name, name)) for name in dataset.fitted])
    own = np.array([base.model.names.index(n) for n in dataset.fitted if n in effects], dtype=int)
    for k, name in ((1, "geometry"), (2, "compliance")):
        if not (stage == k).any():
            continue
        later = tuple(p for p, effect in effects.items() if stage_of(effect) > k)
        X = data.X
        if later:
            x = np.where(np.isin(base.model.names, later), base.model.nominal, base.x)
            B = base.model.regressor(base.observed.table, x, own, base.observed).B
            B = B.reshape(len(good), blocks.size, -1) * prior_deviations(base)[own]
            X = np.concatenate([blocks.pack(B), X[:, :, len(own) :]], axis=2)
        part = replace(data, X=X[:, :, stage <= k], precision=data.precision[stage <= k])
        left = left_out_residual(project(part, noise.of_instrument()))
        few = data.n_rows < SPARE * part.X.shape[2]
        with suppress(ElastocalError):
            held = left_out(base.model, subset(base.observed, good), later) if few else np.inf
            if np.isfinite(held).all():
                rows[good] = np.reshape(held, (-1, blocks.size, 1))
                left = blocks.pack(rows)[:, :, 0]
        steps.append(BudgetStep(name, *rms_with_interval(data, left, rng)))
    return steps


def with_intervals(drawn: Array) -> tuple[float, Interval, Interval]:
    """The median of draws (n,), and the 90 and 95 % intervals."""
    ends = np.quantile(drawn, [0.025, 0.05, 0.5, 0.95, 0.975])
    low95, low90, middle, high90, high95 = ends.tolist()
    return middle, (low90, high90), (low95, high95)


# Faulty readings: those that noise does not explain, as in identification; of which each joint has
# a part where several markers of a visit tell that from the arm's own errors.

RUN = 3  # so many neighbours in a row, of one marker, are no accident either


def screen_outliers(dataset: DiagnosisData, data: NoisyData) -> tuple[BoolArray, BoolArray]:
    """The faulty ones (N,) among the readings of `data`, those of `dataset` with what was found
    beside, and suspects (N,) that were kept: too many, or too near each other to be accidents.
    Runs of one marker's readings are kept: something happened to it; so are visits all of whose
    markers are off together, unless repeats contradict them: the flange was elsewhere."""
    base, blocks = dataset.base, dataset.blocks
    readings = linearised(base.model, base.observed, base.x, np.zeros(0, dtype=np.int64))
    r = blocks.unpack(data.r[..., None])
    B = blocks.unpack(data.X / np.sqrt(data.precision)).reshape(r.size, -1)
    # What the readings tell of the parameters, beside what was known of them.
    U, shown, _ = linalg.svd(B, full_matrices=False, lapack_driver="gesvd")
    U = U[:, : max(int((shown > np.sqrt(data.mean_variance)).sum()), 1)]
    B, e = U.reshape(*r.shape[:2], -1), r - (U @ (U.T @ r.ravel())).reshape(r.shape)
    in_visit, own = np.bincount(blocks.visit), "stated" if data.stated else "independent"
    # A visit that is off as a whole widens the scatter of joints that all readings tell.
    kinds = [own, f"{own}+{JOINTS}"] if np.median(in_visit) >= SEVERAL else [own]

    def contradicted(B: Array, e: Array) -> BoolArray:
        good, now = np.ones(blocks.n, dtype=bool), replace(readings, B=B, e=e[..., 0])
        with suppress(ElastocalError):  # so few judge none
            for kind in kinds:
                good = settle(now, kind, good)[1]
            return ~good
        return np.zeros_like(good)

    suspects = contradicted(B, e)
    if suspects.mean() > FEW or follow_poses(base.observed, suspects):
        return np.zeros_like(suspects), suspects
    faulty = suspects & ~in_a_run(dataset, suspects)
    whole = np.flatnonzero((in_visit > 1) & (np.bincount(blocks.visit, ~suspects) == 0))
    if len(whole):
        moved = blocks.unpack(dataset.entry(("link_frame", (f"link{base.model.chain.n_joints}",))))
        for visit in whole:  # of which count what no motion of the flange is
            rows = blocks.visit == visit
            Q = linalg.orth(moved[rows].reshape(-1, moved.shape[2]), rcond=1e-6)
            for values in (B, e):
                mine = values[rows].reshape(len(Q), -1)
                values[rows] = (mine - Q @ (Q.T @ mine)).reshape(values[rows].shape)
        place = base.observed.place
        agree = np.bincount(place, ~suspects)[place] > 0
        faulty &= ~np.isin(blocks.visit, whole) | agree | contradicted(B, e)
    return faulty, suspects & ~faulty


def in_a_run(dataset: DiagnosisData, suspect: BoolArray) -> BoolArray:
    """Suspects (N,) in a row of RUN or more readings of one marker in time."""
    marker_of, out = dataset.table.marker[dataset.lead], np.zeros(len(suspect), dtype=bool)
    for marker in np.unique(marker_of):
        mine = np.flatnonzero(marker_of == marker)
        mine = mine[np.argsort(dataset.moment[mine], kind="stable")]
        if suspect[mine].sum() >= RUN:
            out[mine] = scipy.ndimage.binary_opening(suspect[mine], np.ones(RUN))
    return out
