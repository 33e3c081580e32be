"""Faulty readings, found one by one against all others, before anything is blamed on the arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.diagnosis.noise import NoiseValues, NoisyData
from elastocal.diagnosis.projection import Projection, project
from elastocal.diagnosis.result import FaultyReading
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 20
LEVEL = 0.01  # chance that any of all good readings is taken for faulty
MOST = 0.1  # share of readings beyond which "faulty" is no accident of measuring
RUN = 3  # so many neighbours in a row, of one marker, are no accident either
ACCIDENT = 1e-3  # chance below which suspects stand together by more than accident


@dataclass(frozen=True)
class Screened:
    """`faulty` (N,) readings, and `suspects` (N,) that were kept: too many, or too near each other
    to be accidents of measuring."""

    faulty: Mask
    suspects: Mask


def screen(scene: Scene, data: NoisyData) -> Screened:
    """The faulty ones among the readings of `data`, the scene's with what was found beside.

    A reading i left out has the error P_ii⁻¹u_i with covariance P_ii⁻¹ (u = P r), so
    uᵢᵀP_ii⁻¹u_i follows χ² with as many degrees of freedom as it has components.  The noise is the
    usual one and not the fitted one, which faulty readings swell; the median of all sets its
    scale, so that an effect still missing from the model does not make readings faulty.  Of each
    visit the worst goes first, for beside it the others look wrong too.  Runs of one marker's
    readings are kept: something happened to it; and where suspects prefer one marker, load state
    or half of the campaign, all are kept, for the same reason.
    """
    blocks = scene.blocks
    usual = NoiseValues.usual(data.G.shape[2])
    limit = stats.chi2.isf(LEVEL / blocks.n, blocks.size)
    middle = stats.chi2.median(blocks.size)
    faulty = np.zeros(blocks.n, dtype=bool)
    beyond = faulty.copy()
    for _ in range(ROUNDS):
        squared = reading_errors(scene, project(data.without(faulty), usual))
        suspect = squared > limit * np.nanmedian(squared) / middle
        beyond |= suspect
        suspect &= ~in_a_run(scene, suspect)
        worst = np.zeros(int(blocks.visit.max()) + 1)
        np.maximum.at(worst, blocks.visit, np.where(suspect, squared, 0.0))
        now = suspect & (squared == worst[blocks.visit])
        if not now.any() or faulty.mean() > MOST:
            break
        faulty |= now
    for k in np.flatnonzero(faulty):
        # A good reading may have looked wrong beside a faulty one that was still there.
        others = faulty.copy()
        others[k] = False
        squared = reading_errors(scene, project(data.without(others), usual))
        faulty[k] = squared[k] > limit * np.nanmedian(squared) / middle
    if faulty.mean() > MOST or not accidental(scene, faulty):
        faulty[:] = False
    return Screened(faulty, beyond & ~faulty)


def accidental(scene: Scene, faulty: Mask) -> bool:
    """Whether the faulty readings (N,) spread over markers, load states and time as all do."""
    table, lead = scene.base.seen.table, scene.base.seen.lead
    loaded = np.any(table.force != 0, axis=1)[lead]
    moment = lead if table.time is None else table.time[lead]
    for label in (table.marker[lead], loaded, moment > np.median(moment)):
        groups = np.unique(label)
        if len(groups) < 2 or not faulty.any():
            continue
        counts = np.array([[(faulty & (label == g)).sum(), (label == g).sum()] for g in groups])
        found, size = counts.T
        # Each group's count given the total is hypergeometric; the most conspicuous one decides.
        p = stats.hypergeom.sf(found - 1, size.sum(), found.sum(), size).min() * len(groups)
        if p < ACCIDENT:
            return False
    return True


def reading_errors(scene: Scene, at: Projection) -> Array:
    """uᵢᵀP_ii⁻¹u_i (N,) of every observation; NaN where it is left out."""
    blocks, size = scene.blocks, scene.blocks.size
    C, M = blocks.member.shape
    P = at.inverse - at.H @ at.H.transpose(0, 2, 1)
    place = np.arange(M)
    own = P.reshape(C, M, size, M, size)[:, place, :, place, :].transpose(1, 0, 2, 3)
    u = at.u.reshape(C, M, size)
    own = own + 1e-12 * np.trace(own, axis1=2, axis2=3)[..., None, None] * np.eye(size)
    squared = (u * np.linalg.solve(own, u[..., None])[..., 0]).sum(axis=2)
    squared[scene.data.left_out.reshape(C, M, size)[:, :, 0]] = np.nan
    out = np.full(blocks.n + 1, np.nan)
    out[blocks.member.ravel()] = squared.ravel()
    return out[:-1]


def in_a_run(scene: Scene, suspect: Mask) -> Mask:
    """Suspects (N,) that stand in a row of RUN or more readings of the same marker in time."""
    table, lead = scene.base.seen.table, scene.base.seen.lead
    moment = lead if table.time is None else table.time[lead]
    out = np.zeros(len(suspect), dtype=bool)
    for marker in np.unique(table.marker[lead]):
        mine = np.flatnonzero(table.marker[lead] == marker)
        mine = mine[np.argsort(moment[mine], kind="stable")]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], suspect[mine].astype(int), [0]])))
        for start, stop in edges.reshape(-1, 2):
            if stop - start >= RUN:
                out[mine[start:stop]] = True
    return out


def describe_faulty(scene: Scene, data: NoisyData, noise: NoiseValues) -> tuple[FaultyReading, ...]:
    """The readings left out, with their error against the fit to the others."""
    blocks, size = scene.blocks, scene.blocks.size
    out = data.faulty
    if not out.any():
        return ()
    at = project(data, noise)
    e = blocks.unpack((data.r - data.X @ at.beta)[..., None])[:, :, 0]
    sigma = np.sqrt(np.einsum("nii->ni", blocks.unpack_square(data.covariance)) * noise.factor**2)
    table, lead = scene.base.seen.table, scene.base.seen.lead
    return tuple(
        FaultyReading(
            int(table.row[lead[k]]),
            table.configuration_labels[table.configuration[lead[k]]],
            table.marker_names[table.marker[lead[k]]],
            float(np.linalg.norm(e[k, :3])),
            float(np.linalg.norm(e[k, :size] / sigma[k])),
        )
        for k in np.flatnonzero(out)
    )
