"""Faulty readings: found one by one against all others, before anything is blamed on the arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special
from scipy.spatial import cKDTree

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, Projection, project
from elastocal.units import Array, BoolArray, IntArray

# A reading i left out has the error e = P_ii⁻¹u_i with covariance P_ii⁻¹ (u = P r), so uᵢᵀP_ii⁻¹u_i
# follows χ² with as many degrees of freedom as it has components, if the model is right.  Where it
# is not, an arm's own error is larger than any χ² allows, and only what no arm can do is a fault:
#
#   - the other markers of the same visit: no error of an arm changes their distances on the flange.
#     With the flange free to move, the reading's part w of what is left of its visit follows χ²;
#   - repeats of the same pose and load: the arm does there what it did;
#   - without either, neighbours in the joints: an error that they share is the arm's.
#
# An error that one of the first two would have shown and does not is none of the reading's.

ROUNDS = 20
LEVEL = 0.01  # chance that any of all good readings is taken for faulty
MOST = 0.1  # share of readings from which on "faulty" is no accident of measuring
RUN = 3  # so many neighbours in a row, of one marker, are no accident either
ACCIDENT = 1e-3  # chance below which suspects stand together by more than accident
NEIGHBOURS = 3  # poses whose errors a reading's is compared with
TINY = 1e-300
HEAVIEST, LIGHTEST = 2.0, 1e3  # degrees of freedom of a tail
SEEN = 0.02  # share of an error's square below which the flange's own motion hides it


@dataclass(frozen=True)
class OutlierScreening:
    """`faulty` (N,) readings, and `suspects` (N,) that were kept: too many, or too near each other
    to be accidents of measuring."""

    faulty: BoolArray
    suspects: BoolArray


def screen_outliers(dataset: DiagnosisData, data: NoisyData) -> OutlierScreening:
    """The faulty ones among the readings of `data`, those of `dataset` with what was found beside.

    The noise is the usual one and not the fitted one, which faulty readings swell; the median of
    all sets its scale and their spread its tail, so that an effect still missing from the model
    does not make readings faulty.  Of each visit, and of each pose's repeats, the worst goes
    first, for beside it the others look wrong too.  Runs of one marker's readings are kept:
    something happened to it; and where suspects prefer one marker, load state or half of the
    campaign, all are kept, for the same reason.
    """
    blocks, check = dataset.blocks, DirectChecks(dataset)
    faulty = np.zeros(blocks.n, dtype=bool)
    conspicuous = faulty.copy()
    for _ in range(ROUNDS):
        excess = check.excess(data.without(faulty))
        suspect = excess > 1
        conspicuous |= suspect
        suspect &= ~in_a_run(dataset, suspect)
        now = suspect.copy()
        for group in (blocks.visit, dataset.repeated):
            worst = np.zeros(int(group.max()) + 1)
            np.maximum.at(worst, group, np.where(suspect, excess, 0.0))
            now &= excess == worst[group]
        if not now.any() or faulty.mean() > MOST:
            break
        faulty |= now
    for k in np.flatnonzero(faulty):
        # A good reading may have looked wrong beside a faulty one that was still there.
        others = faulty.copy()
        others[k] = False
        faulty[k] = check.excess(data.without(others))[k] > 1
    if faulty.mean() > MOST or not accidental(dataset, faulty):
        faulty[:] = False
    return OutlierScreening(faulty, conspicuous & ~faulty)


class DirectChecks:
    """How far a reading is beyond what its model, its visit, its repeats and its neighbours
    allow."""

    def __init__(self, dataset: DiagnosisData) -> None:
        self.dataset = dataset
        self.size = dataset.blocks.size
        self.scales: dict[str, dict[int, float]] = {"visits": {}, "repeats": {}}
        self.stated = dataset.data.stated
        self.usual = NoiseValues.usual(dataset.data.G.shape[2])
        last = f"link{dataset.base.model.chain.n_joints}"
        rigid = dataset.entry(("link_frame", (last,)))
        self.rigid = dataset.blocks.unpack(rigid)
        self.covariance = dataset.blocks.unpack_square(dataset.data.covariance)
        order = np.argsort(dataset.blocks.visit, kind="stable")
        ends = np.flatnonzero(np.diff(dataset.blocks.visit[order])) + 1
        self.visits = [v for v in np.split(order, ends) if len(v) > 1]

    def excess(self, data: NoisyData) -> Array:
        """Squared error (N,) of every reading over what is allowed; 0 where it is left out.

        By the model, or less where visit, repeats or neighbours speak for the reading.
        """
        at, used = project(data, self.usual), ~data.faulty
        squared, error, weight = left_out_errors(self.dataset, at, used)
        chi2 = float(special.chdtri(self.size, LEVEL / len(used)))
        median = max(float(np.median(squared[used])), TINY)
        scale = median / float(special.chdtri(self.size, 0.5))
        out = np.where(used, squared, 0.0) / (chi2 * scale)
        suspect = out > 1
        if not suspect.any():
            return out
        e = self.dataset.blocks.unpack((data.r - data.X @ at.beta)[..., None])[:, :, 0]
        direct = np.full(len(out), np.nan)
        for found, power in (
            self._within_visits(e, error, used, suspect), self._repeated(e, error, used),
        ):  # fmt: skip
            told = suspect & (power > 1)
            direct[told] = np.fmax(direct[told], found[told])
        told = ~np.isnan(direct)
        out[told] = np.minimum(out[told], direct[told])
        alone = np.flatnonzero(suspect & ~told)
        near = self._unlike_neighbours(error, weight, alone, used)
        out[alone] = np.minimum(squared[alone], near) / self._tail(squared[used])
        return out

    def _tail(self, squared: Array) -> float:
        """Limit of statistics (n,) that follow a scaled F(size, ν), χ² where ν → ∞.

        The scale is set by the median.  Where more lie beyond the ninth decile of χ² than chance
        allows, ν is the one whose ninth decile is theirs: errors of a model that is not right
        have heavy tails, and what lies in a tail that begins among the good ones is no fault.
        """
        k, n, median = self.size, len(squared), max(float(np.median(squared)), TINY)
        level, ninth = LEVEL / self.dataset.blocks.n, float(np.quantile(squared, 0.9))
        tenth, half, limit = special.chdtri(k, [0.1, 0.5, level])
        beyond = int((squared > tenth * median / half).sum())
        by_chi2 = float(limit / half) * median
        if special.bdtrc(beyond - 1, n, 0.1) > ACCIDENT:
            return by_chi2

        def too_heavy(log_dof: float) -> float:
            high, half = special.fdtri(k, np.exp(log_dof), [0.9, 0.5])
            return float(high / half - ninth / median)

        low, high = float(np.log(HEAVIEST)), float(np.log(LIGHTEST))
        if too_heavy(high) >= 0:
            return by_chi2
        nu = np.exp(low if too_heavy(low) <= 0 else optimize.brentq(too_heavy, low, high))
        limit, half = special.fdtri(k, nu, [1 - level, 0.5])
        return float(limit / half) * median

    def _within_visits(
        self, e: Array, error: Array, used: BoolArray, suspect: BoolArray
    ) -> tuple[Array, Array]:
        """What the markers' distances allow, of the residuals e (N, size), and whether they would
        have shown the reading's `error` (N, size): both over their limits.

        With the visit's rows whitened, e and the flange's six motions A, is Q = I − AA⁺ and
        w = Q e; of a reading alone, wᵢᵀQ_ii⁺wᵢ and, as it would be, errorᵀQ_ii error.
        """
        n = len(used)
        squared, power, dof = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64)
        k = self.size
        for visit in self.visits:
            rows = visit[used[visit]]
            # All visits are looked at once, for the scale, then those with suspects.
            if len(rows) < 2 or (self.scales["visits"] and not suspect[rows].any()):
                continue
            root = np.linalg.inv(np.linalg.cholesky(self.covariance[rows]))
            A = (root @ self.rigid[rows]).reshape(len(rows) * k, -1)
            U, s, _ = np.linalg.svd(A, full_matrices=False)
            U = U[:, s > 1e-6 * s[0]]
            Q = np.eye(len(A)) - U @ U.T
            w = Q @ (root @ e[rows][..., None]).ravel()
            own = (root @ error[rows][..., None])[..., 0]
            for i, row in enumerate(rows):
                span = slice(i * k, (i + 1) * k)
                values, vectors = np.linalg.eigh(Q[span, span])
                seen = values > SEEN
                along = vectors[:, seen].T
                squared[row] = ((along @ w[span]) ** 2 / values[seen]).sum()
                power[row] = float(own[i] @ Q[span, span] @ own[i])
                dof[row] = int(seen.sum())
        return self._over_limits(squared, power, dof, "visits")

    def _repeated(self, e: Array, error: Array, used: BoolArray) -> tuple[Array, Array]:
        """The same by the other readings of the same marker at the same pose and load, in other
        visits."""
        group = self.dataset.repeated
        count = np.bincount(group, used, minlength=int(group.max()) + 1)
        others = count[group] - used
        total = np.zeros((len(count), self.size))
        np.add.at(total, group[used], e[used])
        mean = (total[group] - np.where(used[:, None], e, 0.0)) / np.maximum(others, 1)[:, None]
        root = np.linalg.inv(np.linalg.cholesky(self.covariance))
        known = used & (others > 0)
        off, own = ((root @ v[..., None])[..., 0] for v in (e - mean, error))
        spread = 1 + 1 / np.maximum(others, 1)
        squared = np.where(known, (off**2).sum(axis=1) / spread, 0.0)
        power = np.where(known, (own**2).sum(axis=1) / spread, 0.0)
        return self._over_limits(squared, power, np.where(known, self.size, 0), "repeats")

    def _over_limits(
        self, squared: Array, power: Array, dof: IntArray, check: str
    ) -> tuple[Array, Array]:
        """χ² statistics (N,) over their limits, the scale set by their median when the `check` is
        first made."""
        found, would = np.zeros_like(squared), np.zeros_like(power)
        for k in np.unique(dof[dof > 0]):
            own = dof == k
            limit = float(special.chdtri(k, LEVEL / len(dof)))
            # Readings better than stated are not faulty yet.
            scale = float(np.median(squared[own])) / float(special.chdtri(k, 0.5))
            scale = self.scales[check].setdefault(int(k), max(scale, 1.0 if self.stated else TINY))
            found[own], would[own] = squared[own] / (limit * scale), power[own] / (limit * scale)
        return found, would

    def _unlike_neighbours(
        self, error: Array, weight: Array, chosen: IntArray, used: BoolArray
    ) -> Array:
        """Squared difference (k,) of the `chosen` readings' errors from the mean error of the
        nearest poses, as if that were exact; `weight` (N, size, size) is P_ii."""
        kind, repeats = self.dataset.kind, self.dataset.repeated
        q = self.dataset.table.q[self.dataset.lead]
        q = q / np.maximum(q.std(axis=0), 1e-12)
        out = np.full(len(chosen), np.inf)
        for own in np.unique(kind[chosen]):
            mine = np.flatnonzero((kind == own) & used)
            mine = mine[np.unique(repeats[mine], return_index=True)[1]]
            if len(mine) <= NEIGHBOURS + 1:
                continue
            tree = cKDTree(q[mine])
            for place in np.flatnonzero(kind[chosen] == own):
                i = chosen[place]
                near = mine[tree.query(q[i], k=NEIGHBOURS + 1)[1]]
                near = near[repeats[near] != repeats[i]][:NEIGHBOURS]
                off = error[i] - error[near].mean(axis=0)
                out[place] = float(off @ weight[i] @ off) / (1 + 1 / len(near))
        return out


def left_out_errors(
    dataset: DiagnosisData, at: Projection, used: BoolArray
) -> tuple[Array, Array, Array]:
    """Of every observation uᵢᵀP_ii⁻¹u_i (N,), its error P_ii⁻¹u_i (N, size) against the fit to the
    others, and P_ii (N, size, size); zeros where it is not `used`."""
    blocks = dataset.blocks
    weight = blocks.unpack_square(at.P)
    trace = np.trace(weight, axis1=1, axis2=2)[:, None, None]
    weight = np.where(used[:, None, None], weight, 0.0)
    regular = weight + (1e-12 * trace + ~used[:, None, None]) * np.eye(blocks.size)
    u = np.where(used[:, None], blocks.unpack(at.u[..., None])[:, :, 0], 0.0)
    error = np.linalg.solve(regular, u[..., None])[..., 0]
    return (u * error).sum(axis=1), error, weight


def accidental(dataset: DiagnosisData, faulty: BoolArray) -> bool:
    if not faulty.any():
        return True
    from scipy.stats import hypergeom  # slow to import, seldom asked for

    table, lead, moment = dataset.table, dataset.lead, dataset.moment
    loaded = np.any(table.force != 0, axis=1)[lead]
    for label in (table.marker[lead], loaded, moment > np.median(moment)):
        groups = np.unique(label)
        if len(groups) < 2:
            continue
        counts = np.array([[(faulty & (label == g)).sum(), (label == g).sum()] for g in groups])
        found, size = counts.T
        # Each group's count given the total is hypergeometric; the most conspicuous one decides.
        p = hypergeom.sf(found - 1, size.sum(), found.sum(), size).min() * len(groups)
        if p < ACCIDENT:
            return False
    return True


def in_a_run(dataset: DiagnosisData, suspect: BoolArray) -> BoolArray:
    """Suspects (N,) that stand in a row of RUN or more readings of the same marker in time."""
    marker_of, moment = dataset.table.marker[dataset.lead], dataset.moment
    out = np.zeros(len(suspect), dtype=bool)
    for marker in np.unique(marker_of):
        mine = np.flatnonzero(marker_of == marker)
        mine = mine[np.argsort(moment[mine], kind="stable")]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], suspect[mine].astype(int), [0]])))
        for start, stop in edges.reshape(-1, 2):
            if stop - start >= RUN:
                out[mine[start:stop]] = True
    return out
