"""Faulty readings: each judged against all others, before anything is blamed on the arm."""

from __future__ import annotations

import numpy as np
import scipy  # whose `ndimage` loads where it is used, as `stats` does
from scipy import special
from scipy.spatial import cKDTree

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, project
from elastocal.identification.outliers import deleted
from elastocal.identification.weighted_problem import same_size
from elastocal.measurements import numbered
from elastocal.units import Array, BoolArray, IntArray

# A reading i left out has an error d whose square dᵀP_ii d follows χ², if the model is right.
# Where it is not, an arm's own error is larger than any χ² allows, and only what no arm can do is
# a fault.  That others show beside which the arm's error is a part of the noise, as large as need
# be:
#
#   - the other markers of the same visit: the flange may be anywhere;
#   - repeats of the same pose, marker and load: the place may be anywhere;
#   - without either, neighbours in the joints: an error that they share is the arm's.
#
# An error that one of the first two would have shown and does not is none of the reading's.

ROUNDS = 20
LEVEL = 0.01  # chance that any of all good readings is taken for faulty
MOST = 0.1  # share of readings from which on "faulty" is no accident of measuring
RUN = 3  # so many neighbours in a row, of one marker, are no accident either
ACCIDENT = 1e-3  # chance below which suspects stand together by more than accident
TINY = 1e-300
TAILS = np.geomspace(2.0, 1e3, 200)  # degrees of freedom that a tail may have
NEIGHBOURS = 3  # poses whose errors a reading's is compared with
APART = 1e6  # deviations of a joint, between those that are no neighbours
SEEN = 0.02  # share of an error's square below which the flange's own motion hides it


def screen_outliers(dataset: DiagnosisData, data: NoisyData) -> tuple[BoolArray, BoolArray]:
    """The faulty ones (N,) among the readings of `data`, those of `dataset` with what was found
    beside, and suspects (N,) that were kept: too many, or too near each other to be accidents.

    The noise is the usual one and not the fitted one, which faulty readings swell; the median of
    all sets its scale and their spread its tail, so that an effect still missing from the model
    does not make readings faulty.  Of each visit, and of each pose's repeats, the worst goes
    first, for beside it the others look wrong too.  Runs of one marker's readings are kept:
    something happened to it; and where suspects prefer one marker, load state or half of the
    campaign, all are kept, for the same reason.
    """
    blocks = dataset.blocks
    faulty = np.zeros(blocks.n, dtype=bool)
    conspicuous = faulty.copy()
    for _ in range(ROUNDS):
        excess = excess_of(dataset, data.without(faulty))
        suspect = excess > 1
        conspicuous |= suspect
        suspect &= ~in_a_run(dataset, suspect)
        now = suspect.copy()
        for group in (blocks.visit, dataset.base.observed.place):
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
        faulty[k] = excess_of(dataset, data.without(others))[k] > 1
    if faulty.mean() > MOST or not accidental(dataset, faulty):
        faulty[:] = False
    return faulty, conspicuous & ~faulty


def excess_of(dataset: DiagnosisData, data: NoisyData) -> Array:
    """Squared error (N,) of every reading over what is allowed; 0 where it is left out.

    By the model, or less where visit or repeats, else neighbours, speak for the reading.
    """
    blocks, used = dataset.blocks, np.flatnonzero(~data.faulty)
    size, level, out = blocks.size, LEVEL / blocks.n, np.zeros(blocks.n)
    at = project(data, NoiseValues.usual(data.G.shape[2]))
    P, own = blocks.unpack_square(at.P)[used], blocks.unpack_square(data.covariance)[used]
    error = deleted(P, blocks.unpack(at.u[..., None])[used, :, 0], own, np.zeros(len(used)))[0]
    squared = np.einsum("ni,nij,nj->n", error, P, error)
    half, limit = special.chdtri(size, [0.5, level])
    out[used] = squared / (limit / half * max(float(np.median(squared)), TINY))
    if not (out > 1).any():
        return out
    root = np.linalg.inv(np.linalg.cholesky(own))
    e = root @ blocks.unpack((data.r - data.X @ at.beta)[..., None])[used]
    last = f"link{dataset.base.model.chain.n_joints}"
    moved = root @ blocks.unpack(dataset.entry(("link_frame", (last,))))[used]
    told = np.full(len(used), np.nan)
    for group, shared in ((blocks.visit, moved), (dataset.base.observed.place, root)):
        found, would, dof = _beside(group[used], shared, e, root @ error[..., None])
        for k in np.unique(dof[dof > 0]):
            mine = dof == k
            half, limit = special.chdtri(k, [0.5, level])
            # Readings better than stated are not faulty yet.
            least = 1.0 if data.stated else TINY
            limit *= max(float(np.median(found[mine]) / half), least)
            told = np.where(mine & (would > limit), np.fmax(told, found / limit), told)
    alone = np.minimum(squared, _unlike_neighbours(dataset, used, error, P))
    alone /= _tail(squared, size, level)
    told = np.where(np.isnan(told), alone, np.minimum(told, out[used]))
    out[used] = np.where(out[used] > 1, told, out[used])
    return out


def _unlike_neighbours(dataset: DiagnosisData, used: IntArray, error: Array, P: Array) -> Array:
    """Squared difference (n,) of the errors (n, size) of the readings `used` from the mean error of
    the nearest poses, of the same marker and load, as if that were exact."""
    q = dataset.table.q[dataset.lead[used]]
    place = np.column_stack([q / np.maximum(q.std(axis=0), 1e-12), APART * dataset.kind[used]])
    first = np.unique(dataset.base.observed.place[used], return_index=True)[1]
    if len(first) <= NEIGHBOURS:
        return np.full(len(used), np.inf)
    distance, near = cKDTree(place[first]).query(place, k=NEIGHBOURS + 1)
    off = error - error[first[near[:, 1:]]].mean(axis=1)  # the first is its own pose
    squared = np.einsum("ni,nij,nj->n", off, P, off) / (1 + 1 / NEIGHBOURS)
    return np.where(distance[:, -1] < APART / 2, squared, np.inf)


def _tail(squared: Array, size: int, level: float) -> float:
    """Limit at this `level` of statistics (n,) that follow a scaled F(size, ν), χ² where ν → ∞.

    The scale is set by the median.  Where more lie beyond the ninth decile of χ² than chance
    allows, ν is the one whose ninth decile is theirs: errors of a model that is not right have
    heavy tails, and what lies in a tail that begins among the good ones is no fault.
    """
    median, ninth = np.maximum(np.quantile(squared, [0.5, 0.9]), TINY)
    tenth, half, limit = special.chdtri(size, [0.1, 0.5, level])
    beyond = int((squared > tenth * median / half).sum())
    if special.bdtrc(beyond - 1, len(squared), 0.1) <= ACCIDENT:
        ratio = special.fdtri(size, TAILS, 0.9) / special.fdtri(size, TAILS, 0.5)
        nu = np.exp(np.interp(-ninth / median, -ratio, np.log(TAILS)))
        half, limit = special.fdtri(size, nu, [0.5, 1 - level])
    return float(limit / half * median)


def _beside(
    group: IntArray, shared: Array, e: Array, error: Array
) -> tuple[Array, Array, IntArray]:
    """What the others of a reading's group make of it, of whitened residuals `e` (n, size, 1) and
    motions `shared` (n, size, k) that a group has in common: its squared error (n,), what that
    would be of its `error` (n, size, 1), and the directions (n,) that they show.

    With A the motions of a group and Q = I − AA⁺, w = Q e: wᵢᵀQ_ii⁺wᵢ and errorᵀQ_ii error.
    """
    (n, size, k), dof = shared.shape, np.zeros(len(e), dtype=np.int64)
    squared, would = np.zeros(n), np.zeros(n)
    for rows in same_size(group):
        if rows.shape[1] < 2:
            continue
        U, s, _ = np.linalg.svd(shared[rows].reshape(len(rows), -1, k), full_matrices=False)
        U = U * (s > 1e-6 * s[:, :1])[:, None]
        w = e[rows].reshape(len(rows), -1, 1)
        w = (w - U @ (U.transpose(0, 2, 1) @ w)).reshape(*rows.shape, size, 1)
        U = U.reshape(*rows.shape, size, -1)
        Q = np.eye(size) - U @ U.swapaxes(2, 3)
        values, vectors = np.linalg.eigh(Q)
        seen = values > SEEN
        along = (vectors.swapaxes(2, 3) @ w)[..., 0] ** 2
        squared[rows] = np.where(seen, along / np.where(seen, values, 1.0), 0.0).sum(axis=2)
        would[rows] = (error[rows].swapaxes(2, 3) @ Q @ error[rows])[..., 0, 0]
        dof[rows] = seen.sum(axis=2)
    return squared, would, dof


def accidental(dataset: DiagnosisData, faulty: BoolArray) -> bool:
    if not faulty.any():
        return True
    table, lead, moment = dataset.table, dataset.lead, dataset.moment
    loaded = np.any(table.force != 0, axis=1)[lead]
    for label in (table.marker[lead], loaded, moment > np.median(moment)):
        group = numbered(label)
        found, size = np.bincount(group, faulty), np.bincount(group)
        # Each group's count given the total is hypergeometric; the most conspicuous one decides.
        p = scipy.stats.hypergeom.sf(found - 1, size.sum(), found.sum(), size).min() * len(size)
        if len(size) > 1 and p < ACCIDENT:
            return False
    return True


def in_a_run(dataset: DiagnosisData, suspect: BoolArray) -> BoolArray:
    """Suspects (N,) that stand in a row of RUN or more readings of the same marker in time."""
    marker_of, out = dataset.table.marker[dataset.lead], np.zeros(len(suspect), dtype=bool)
    for marker in np.unique(marker_of):
        mine = np.flatnonzero(marker_of == marker)
        mine = mine[np.argsort(dataset.moment[mine], kind="stable")]
        if suspect[mine].sum() >= RUN:
            out[mine] = scipy.ndimage.binary_opening(suspect[mine], np.ones(RUN))
    return out
