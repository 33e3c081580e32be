"""Faulty readings: found one by one against all others, before anything is blamed on the arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from scipy import special
from scipy.spatial import cKDTree

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, project
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
        self.dataset, blocks = dataset, dataset.blocks
        self.size = size = blocks.size
        self.usual = NoiseValues.usual(dataset.data.G.shape[2])
        last = f"link{dataset.base.model.chain.n_joints}"
        rigid = blocks.unpack(dataset.entry(("link_frame", (last,))))
        same = np.broadcast_to(np.eye(size), (blocks.n, size, size))
        root = np.linalg.inv(np.linalg.cholesky(blocks.unpack_square(dataset.data.covariance)))
        self.root = np.asarray(root, dtype=np.float64)
        self.shared = [(_groups(blocks.visit), rigid), (_groups(dataset.repeated), same)]
        self.scales: list[dict[int, float]] = [{}, {}]

    def excess(self, data: NoisyData) -> Array:
        """Squared error (N,) of every reading over what is allowed; 0 where it is left out.

        By the model, or less where visit, repeats or neighbours speak for the reading.
        """
        at, used, blocks = project(data, self.usual), ~data.faulty, self.dataset.blocks
        weight = np.where(used[:, None, None], blocks.unpack_square(at.P), 0.0)
        trace = np.trace(weight, axis1=1, axis2=2)[:, None, None]
        u = np.where(used[:, None], blocks.unpack(at.u[..., None])[:, :, 0], 0.0)
        regular = weight + (1e-12 * trace + ~used[:, None, None]) * np.eye(self.size)
        error = np.linalg.solve(regular, u[..., None])[..., 0]
        squared = (u * error).sum(axis=1)
        chi2 = float(special.chdtri(self.size, LEVEL / len(used)))
        median = max(float(np.median(squared[used])), TINY)
        out = squared / (chi2 * median / float(special.chdtri(self.size, 0.5)))
        suspect = out > 1
        if not suspect.any():
            return out
        e = blocks.unpack((data.r - data.X @ at.beta)[..., None])[:, :, 0]
        direct = np.full(len(out), np.nan)
        for (groups, shared), scales in zip(self.shared, self.scales, strict=True):
            found, would = self._beside(groups, shared, scales, e, error, used, suspect)
            told = suspect & (would > 1)
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
        nu = np.exp(low if too_heavy(low) <= 0 else scipy.optimize.brentq(too_heavy, low, high))
        limit, half = special.fdtri(k, nu, [1 - level, 0.5])
        return float(limit / half) * median

    def _beside(
        self, groups: list[IntArray], shared: Array, scales: dict[int, float], e: Array,
        error: Array, used: BoolArray, suspect: BoolArray,
    ) -> tuple[Array, Array]:  # fmt: skip
        """What the others of a reading's group allow, of the residuals e (N, size), and whether
        they would have shown the reading's `error` (N, size): both over their limits.

        With the group's rows whitened, e and the motions A that its readings have in common
        (`shared`), is Q = I − AA⁺ and w = Q e; of a reading alone, wᵢᵀQ_ii⁺wᵢ and, as it would be,
        errorᵀQ_ii error follow χ², their scale set by the median when they are first looked at.
        """
        n, k = len(used), self.size
        squared, power, dof = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64)
        for group in groups:
            rows = group[used[group]]
            # All are looked at once, for the scale, then those with suspects.
            if len(rows) < 2 or (scales and not suspect[rows].any()):
                continue
            root = self.root[rows]
            A = (root @ shared[rows]).reshape(len(rows) * k, -1)
            U, s, _ = np.linalg.svd(A, full_matrices=False)
            U = U[:, s > 1e-6 * s[0]]
            Q = np.eye(len(A)) - U @ U.T
            w = (Q @ (root @ e[rows][..., None]).ravel()).reshape(-1, k)
            own = (root @ error[rows][..., None])[..., 0]
            at = np.arange(len(rows))
            Q = Q.reshape(len(rows), k, len(rows), k)[at, :, at]
            values, vectors = np.linalg.eigh(Q)
            seen = values > SEEN
            along = np.einsum("nij,ni->nj", vectors, w) ** 2
            squared[rows] = np.where(seen, along / np.where(seen, values, 1.0), 0.0).sum(axis=1)
            power[rows] = np.einsum("ni,nij,nj->n", own, Q, own)
            dof[rows] = seen.sum(axis=1)
        for number in np.unique(dof[dof > 0]):
            mine = dof == number
            half, limit = special.chdtri(number, [0.5, LEVEL / n])
            # Readings better than stated are not faulty yet.
            least = 1.0 if self.dataset.data.stated else TINY
            scale = max(float(np.median(squared[mine]) / half), least)
            limit *= scales.setdefault(int(number), scale)
            squared[mine] /= limit
            power[mine] /= limit
        return squared, np.where(dof > 0, power, 0.0)

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


def _groups(number: IntArray) -> list[IntArray]:
    """Members of each group of more than one."""
    order = np.argsort(number, kind="stable")
    ends = np.flatnonzero(np.diff(number[order])) + 1
    return [group for group in np.split(order, ends) if len(group) > 1]


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
        found, size = np.transpose(
            [[(faulty & of).sum(), of.sum()] for of in label == groups[:, None]]
        )
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
