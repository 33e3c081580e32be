"""Before the first fit: what is asked for, does the table fit the robot, where are its markers?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Literal, get_args

import casadi as ca
import numpy as np
import scipy  # whose `optimize` and `spatial` load where they are used, as long as a small fit
from scipy import special

from elastocal.cell import Cell
from elastocal.identification.knowledge import Constraints, GaussianPrior
from elastocal.identification.noise_structure import Kind
from elastocal.identification.weighted_problem import WeightKind
from elastocal.measurements import Measurements, numbered, visits
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    did_you_mean,
    length,
    listed,
    option,
    quoted,
    require,
    rounded,
)
from elastocal.model.chain import beyond_limits
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.geometry import BaseFrame, MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.model.rigid import rotation_from_vector, vector_from_rotation
from elastocal.units import Array, BoolArray, IntArray, rpy_from_rotation

IntervalKind = Literal[
    "auto", "classical", "hc0", "hc1", "hc2", "hc3", "cr0", "cr1", "cr2", "cr3",
    "profile",
]  # fmt: skip
KINDS = get_args(IntervalKind)
Method = Literal["auto", "reml", "ols", "wls", "eq14", "eq14-residual", "huber", "l1"]
FaultyReadings = Literal["auto", "drop", "keep"]
METHODS = get_args(Method)
ROBUST = ("huber", "l1")
WITH_KNOWLEDGE = ("auto", "profile")
# What there was once, or is looked for by this name: what does the same.
SUCCESSORS = {
    "method": dict.fromkeys(
        ("lts", "s", "mm", "tukey", "student-t"),
        "the default method, which excludes what the fit of the majority contradicts, or huber",
    ),
    "intervals": {
        "wild": "cr2, which allows any correlation within a configuration as well",
        "hc4": "hc3, which is nearly the jackknife over rows",
        "bootstrap": "profile, which is lopsided where the model bends as well",
    },
}


@dataclass(frozen=True)
class Options:
    """How to identify, as `elastocal.identify` says of its arguments; `constraints` and `prior`: a
    fit with knowledge on top of the method's weights (`knowledge_fit`); `faulty`: its outliers."""

    method: Method = "auto"
    noise: str = "auto"
    weights: WeightKind = "auto"
    covariance: Array | None = None
    intervals: IntervalKind = "auto"
    fixed: tuple[str, ...] = ()
    constraints: Constraints | None = None
    prior: GaussianPrior | None = None
    faulty: FaultyReadings = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, valid in (
            ("method", self.method, METHODS),
            ("weights", self.weights, get_args(WeightKind)),
            ("intervals", self.intervals, KINDS),
            ("outliers", self.faulty, get_args(FaultyReadings)),
        ):
            if successor := SUCCESSORS.get(name, {}).get(str(value)):
                raise InputError(f"there is no {option(name, value)}: use {successor}")
            if value not in valid:
                raise InputError(
                    f"{option(name)} takes one of {', '.join(valid)}; found {quoted(value)}"
                    f"{did_you_mean(str(value), valid)}"
                )
        Kind.of(self.noise)
        if self.noise != "auto" and self.resolved != "reml":
            raise InputError(
                f"the noise model '{self.noise}' is estimated by the method reml; "
                f"{self.resolved} takes its weights from elsewhere"
            )
        if self.method == "wls" and self.weights == "none":
            raise InputError("the method wls needs weights; for none, choose the method ols")
        stated = self.weights != "auto" or self.covariance is not None
        if self.covariance is not None and self.weights not in ("auto", "covariance"):
            raise InputError(
                f"{option('covariance')} goes with {option('weights', 'covariance')}; found "
                f"{quoted(self.weights)}, leave one of the two out"
            )
        if stated and self.weights != "none" and self.resolved not in ("wls", *ROBUST):
            raise InputError(
                f"the method {self.resolved} does not take stated weights; choose the method wls"
            )
        if self.knows:
            remedy = f"with these there are {', '.join(WITH_KNOWLEDGE)}"
            self._refuse(ROBUST, WITH_KNOWLEDGE, "neither constraints nor a prior", remedy)

    def check_functions(self) -> None:
        without = (*ROBUST, "eq14", "eq14-residual")
        what = "no prior, which smooth functions have"
        self._refuse(without, ("auto", "classical"), what, "leave it away")

    def _refuse(
        self, without: tuple[str, ...], intervals: tuple[str, ...], what: str, remedy: str
    ) -> None:
        if self.resolved in without:
            raise InputError(
                f"the method {self.resolved} takes {what}; use the default method, which excludes "
                "outliers"
            )
        if self.intervals not in intervals:
            raise InputError(f"{option('intervals', self.intervals)} knows of {what}; {remedy}")

    @property
    def knows(self) -> bool:
        """Whether anything is stated beyond the readings."""
        return self.prior is not None or self.constraints not in (None, Constraints())

    @property
    def resolved(self) -> str:
        """The method that auto stands for."""
        if self.method != "auto":
            return self.method
        if self.weights == "auto" and self.covariance is None:
            return "reml"
        return "ols" if self.weights == "none" else "wls"


# The linear map of readings onto the nominal arm.  With G_i m + t_i the nominal place of a marker
# m, the readings p_i fit where A p_i + s = G_i m + t_i has a solution: linear in A (3, 3), s and m.
# Of such an A, det says whether the frame of the readings is mirrored and by what scale they are
# too short.

UNSKEWED = 1.25  # largest over smallest singular value of an A that may be a rotation and a scale
DIGITS = 1e-12
# A tag, a target or a scale bar is wrong by a few per cent at most; another robot by any factor.
OF_A_TARGET = 0.05
SCALED = 0.005  # no arm's lengths are this far off together, relatively: the readings' are


class LinearFits:
    """Fits of readings `points` (n, 3) of `marker` (n,) or (K, n) to flanges (K, n, 4, 4): A
    (K, 3, 3), the rms (K,) in m that is left in each component, infinite where A is no rotation
    with a scale, and by what the readings (K,) are to be multiplied, `scale`."""

    def __init__(self, flange: Array, points: Array, marker: IntArray) -> None:
        marker = np.broadcast_to(marker, flange.shape[:2])
        own = marker[..., None, None, None] == np.arange(int(marker.max()) + 1)[:, None]
        turned = (flange[..., :3, None, :3] * own).reshape(*marker.shape, 3, -1)
        G = np.concatenate([turned, flange[..., :3, 3:]], axis=3)
        # Rows are components of a reading, one after the other; A and s are the same for all tables
        # and are fitted along by an orthonormal basis.
        Q, R = np.linalg.qr(np.hstack([points - points.mean(axis=0), np.ones((len(points), 1))]))
        along = np.einsum("na,knrm->karm", Q, G)
        off = (G - np.einsum("na,karm->knrm", Q, along)).reshape(len(G), -1, G.shape[3])
        X, y = off[..., :-1], off[..., -1:]
        Xt = X.transpose(0, 2, 1)
        m = -np.linalg.pinv(Xt @ X, rcond=DIGITS, hermitian=True) @ (Xt @ y)
        left = np.sqrt(((X @ m + y) ** 2).mean(axis=(1, 2)))
        self.matrix = np.linalg.pinv(R)[:3] @ (
            along[..., -1] + np.einsum("karm,km->kar", along[..., :-1], m[..., 0])
        )
        size = np.linalg.svd(self.matrix, compute_uv=False)
        left[~(size[:, 0] <= UNSKEWED * size[:, -1])] = np.inf
        self.left, self.determinant = left, np.linalg.det(self.matrix)
        self.scale = np.cbrt(np.abs(self.determinant))


SAMPLE = 400  # readings used: a start needs no more
ROUGH_SWEEPS, SWEEPS = 6, 60
FINALISTS = 4
SETTLED = 1e-6  # change of the median distance, relative, with which the sweeps end
RCOND = 1e-6  # a direction the poses do not show stays at zero instead of running away


# Rotations (24, 3, 3) that turn a cube into itself.
QUARTER_TURNS = [
    turn for axes in permutations(np.eye(3)) for sides in product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.array(axes) * sides) > 0
]  # fmt: skip


class Registration:
    """R_b, t_b, m with p_i = R_b (R_i m_c(i) + t_i) + t_b by robust alternating registration from
    several starts; the best by median distance wins: T_tracker_base as rotation (3, 3) and
    translation (3,), `markers` (M, 3) in the flange frame, and the median distance `error` in m of
    readings from the nominal arm.

    `flange` (n, 4, 4): nominal flange poses in the base frame; `points` (n, 3) readings; `marker`
    (n,) codes into `markers` (M, 3), of which `free` (M,), by default all, are unknown; `base`,
    rotation and translation, where it is known.  Starts: the base turned as the linear
    (non-orthogonal) solution says, as a fit with the start markers says, and as the 24 rotations of
    a cube, so that any attitude is near one.
    """

    def __init__(
        self, flange: Array, points: Array, marker: IntArray, markers: Array,
        free: BoolArray | None = None, base: tuple[Array, Array] | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        if len(points) > SAMPLE:
            some = np.random.default_rng(seed).choice(len(points), SAMPLE, replace=False)
            flange, points, marker = flange[some], points[some], marker[some]
        self._flange, self._points, self._marker, self._base = flange, points, marker, base
        self._free = np.arange(len(markers)) if free is None else np.flatnonzero(free)
        self._fixed = markers.copy()
        self._fixed[self._free] = 0.0
        if base is None:
            U, _, Vt = np.linalg.svd(LinearFits(flange[None], points, marker).matrix[0].T)
            rotation = np.stack([
                U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt,
                _rotation_between(self._body(markers), points, np.ones(len(points))),
                *QUARTER_TURNS,
            ])  # fmt: skip
        else:
            rotation = base[0][None]
        weight = np.ones((len(rotation), len(points)))
        # A few sweeps show which starts lead where; the others need not be gone through to the end.
        for sweeps, left in ((ROUGH_SWEEPS, FINALISTS), (SWEEPS, 1)):
            ends = self._descended(rotation, weight, sweeps)
            nearest = np.argsort(ends[2], kind="stable")[:left]
            rotation, weight, error, translation, placed = (end[nearest] for end in ends)
        self.rotation, self.translation = rotation[0], translation[0]
        self.markers, self.error = placed[0], float(error[0])

    @classmethod
    def of(cls, model: Model, table: Measurements) -> Registration:
        flange, start = model.rigid.flange_poses(table), np.zeros((len(table.marker_names), 3))
        return cls(flange, np.asarray(table.position), table.marker, start)

    def places(self, flange: Array, marker: IntArray) -> Array:
        """Where flanges (n, 4, 4) have each `marker` (n,)."""
        body = np.einsum("nij,nj->ni", flange[:, :3, :3], self.markers[marker]) + flange[:, :3, 3]
        return np.asarray(body @ self.rotation.T + self.translation)

    def _descended(
        self, rotation: Array, weight: Array, sweeps: int
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Rotations, weights, median distances, translations and markers after `sweeps` from every
        `rotation` (s, 3, 3) and `weight` (s, n), all of them together: translation and markers
        (linear) and rotation (Kabsch) in turn, reweighted by distance so that a share of wrong
        readings does not pull the start."""
        error = np.full(len(rotation), np.inf)
        translation, markers = self._linear_parts(rotation, weight)
        for _ in range(sweeps):
            if self._base is None:
                rotation = _rotation_between(self._body(markers), self._points, weight)
            translation, markers = self._linear_parts(rotation, weight)
            predicted = self._body(markers) @ rotation.swapaxes(1, 2) + translation[:, None]
            distance = np.linalg.norm(self._points - predicted, axis=2)
            previous, error = error, np.median(distance, axis=1)
            weight = 1.0 / np.maximum(distance, np.maximum(error, 1e-9)[:, None])
            if (np.abs(previous - error) <= SETTLED * error).all():
                break
        return rotation, weight, error, translation, markers

    def _linear_parts(self, R: Array, weight: Array) -> tuple[Array, Array]:
        """Translation (s, 3) and markers (s, M, 3) for every rotation R (s, 3, 3) and weight (s,
        n).  With u = Rᵀt the equations u + R_i m = Rᵀp − t_i have one matrix for all rotations.
        Its normal equations cost half the digits, which a start can spare."""
        n, known = len(self._points), np.zeros(3) if self._base is None else self._base[1]
        y = (self._points - known) @ R - self._body(self._fixed)
        own = (self._marker[:, None] == self._free)[:, None, :, None]
        turned = (own * self._flange[:, :3, None, :3]).reshape(n, 3, -1)
        base = np.broadcast_to(np.eye(3) * (self._base is None), (n, 3, 3))
        rows = np.concatenate([base, turned], axis=2).reshape(3 * n, -1)
        weighted = (rows * np.repeat(weight, 3, axis=1)[..., None]).transpose(0, 2, 1)
        values, vectors = np.linalg.eigh(weighted @ rows)
        shown = values > RCOND**2 * values[:, -1:]
        right = (weighted @ y.reshape(len(R), -1, 1)).transpose(0, 2, 1)
        along = (right @ vectors)[:, 0] / np.where(shown, values, np.inf)
        x = (vectors @ along[..., None])[..., 0]
        markers = np.tile(self._fixed, (len(R), 1, 1))
        markers[:, self._free] = x[:, 3:].reshape(len(R), -1, 3)
        return known + (R @ x[:, :3, None])[..., 0], markers

    def _body(self, markers: Array) -> Array:
        turned = self._flange[:, :3, :3] @ markers[..., self._marker, :, None]
        return np.asarray(turned[..., 0] + self._flange[:, :3, 3])


def _rotation_between(body: Array, points: Array, weight: Array) -> Array:
    """Weighted Kabsch: R (…, 3, 3) minimising Σ w |p − R b − t|², `body` (…, n, 3)."""
    w = (weight / weight.sum(axis=-1, keepdims=True))[..., None, :]
    b, p = body - w @ body, points - w @ points
    U, _, Vt = np.linalg.svd((p.swapaxes(-1, -2) * w) @ b)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt, dtype=np.float64)


def start_values(
    model: Model, table: Measurements, seed: int = 0, free: IntArray | None = None
) -> Array:
    """Parameter values (parameters,) near the data: nominal, but base, markers and cable placed,
    where they are active and among `free` (default all).  Positions are registered to the nominal
    arm; distances are fitted by a robust multi-start."""
    x = model.nominal.copy()
    movable = set(range(len(x)) if free is None else free.tolist())
    if model.observe == "distance":
        if len(table) > SAMPLE:
            chosen = np.random.default_rng(seed).choice(len(table), SAMPLE, replace=False)
            table = table.take(np.sort(chosen))
        return _distance_start(model, table, x, movable)
    if table.position is None:
        return x
    fitted = (model.parameters[i] for i in movable)
    places = {p.where for p in fitted if p.effect in (BaseFrame.name, MarkerPosition.name)}
    if not places:
        return x
    names = list(model.cell.tool.markers)
    codes = np.array([names.index(m) for m in table.marker_names])[table.marker]
    # Deflected readings would pull the start; unloaded ones serve alone where they are enough
    # and show every marker.
    light = ~np.any(table.force != 0, axis=1)
    enough = light.sum() >= 12 and np.array_equal(np.unique(codes[light]), np.unique(codes))
    rows = np.flatnonzero(light) if enough else np.arange(len(table))
    if len(rows) > SAMPLE:
        rows = np.random.default_rng(seed).choice(rows, SAMPLE, replace=False)
    table, codes = table.take(rows), codes[rows]
    flange, nominal = model.rigid.flange_poses(table), model.cell.model.nominal
    unturned, at = nominal.base_rotation, nominal.base_position
    stated = np.eye(3) if unturned is None else unturned, np.zeros(3) if at is None else at
    found = Registration(
        flange, np.asarray(table.position), codes,
        np.array([model.cell.tool.markers[m] for m in names]),
        np.array([f"marker:{m}" in places for m in names]),
        None if "base" in places else stated, seed,
    )  # fmt: skip
    values = {
        "base.": [*found.translation],
        "base.r": ca.evalf(vector_from_rotation(found.rotation)).elements(),
    }
    values |= {f"marker:{name}.": at for name, at in zip(names, found.markers, strict=True)}
    if model.observe == "pose" and table.rotation is not None:
        Rotation = scipy.spatial.transform.Rotation
        arm = Rotation.from_matrix(found.rotation @ flange[:, :3, :3])
        relative = arm.inv() * Rotation.from_rotvec(table.rotation)
        values |= {f"marker:{names[c]}.r": relative[codes == c].mean().as_rotvec()
                   for c in np.unique(codes)}  # fmt: skip
    of = {
        f"{name}{k}": float(v)
        for name, xyz in values.items()
        for k, v in zip("xyz", xyz, strict=True)
    }
    for i in movable:
        x[i] = of.get(model.names[i], x[i])
    return x


# m: how far nominal distances are off, and a marker from where it is guessed.
ROUGH, AWAY = 2e-3, 0.3


def _distance_start(model: Model, table: Measurements, x: Array, movable: set[int]) -> Array:
    """Anchor, offset and attachment by robust least squares.  With p the nominal flange, d the
    reading, a the anchor and o the offset, |p − a| = d − o is linear in a, o and |a|² − o².  Which
    side of the robot the anchor is on shows only in all poses together: mirror images of that
    solution are tried too, and the best robust cost wins."""
    columns = np.array(
        [i for i, p in enumerate(model.parameters)
         if i in movable and effect_of(p.effect).registered]
    )  # fmt: skip
    if not len(columns):
        return x
    d, place = np.asarray(table.distance), model.rigid.flange_poses(table)[:, :3, 3]
    anchor = [i for i in columns if "anchor" in model.parameters[i].name]
    starts = [x]
    if anchor:
        centre = place.mean(axis=0)
        p, ones = place - centre, np.ones(len(d))
        linear = np.column_stack([-2 * p, -2 * d, ones])
        found = np.linalg.lstsq(linear, d**2 - (p**2).sum(axis=1))[0][:3]
        axes = np.linalg.svd(p, full_matrices=False)[2]
        for side in product((1, -1), repeat=3):
            trial = x.copy()
            trial[anchor] = centre + axes.T @ (side * (axes @ found))
            starts.append(trial)

    def values(z: Array) -> Array:
        y = x.copy()
        y[columns] = z
        return y

    # Where nominal joints do not tell a marker's height from the anchor's, it stays at its guess.
    tie = np.diag([0.0 if i in anchor else ROUGH / AWAY for i in columns])
    tried = [
        scipy.optimize.least_squares(
            lambda z: np.append(model.predict(table, values(z)) - d, tie @ (z - x[columns])),
            start[columns],
            lambda z: np.vstack([model.regressor(table, values(z), columns).B, tie]),
            loss="soft_l1", f_scale=ROUGH, max_nfev=60,
        )
        for start in starts
    ]  # fmt: skip
    return values(min(tried, key=lambda one: float(one.cost)).x)


# Readings and nominal arm may differ this much in extent (a long tool, few joints moving)
# before a wrong unit is the likelier cause.
EXTENT_FACTOR = 30.0
SMALL_ANGLE = np.radians(2 * np.pi)  # what a full turn in rad reads as in degrees
OVERSHOOT = np.radians(0.5)  # controllers overshoot soft limits by a little
SAME = 1e-9
SOME = 2**14  # readings that are enough to tell their unit

# What may be wrong with a table whose joint values no arm can take; "" where nothing tells.
Mistake = Callable[[Model, Measurements], str]


def check_table(model: Model, table: Measurements, mistake: Mistake) -> None:
    """A table to fit: as any table, and more than one pose (InsufficientDataError)."""
    check_rows(model, table, mistake)
    if (table.q == table.q[:1]).all():
        raise InsufficientDataError(
            f"{table.source}: all {len(table)} rows hold the same pose; measure at different "
            "joint angles (at least as many poses as a third of the parameters)"
        )


def check_rows(model: Model, table: Measurements, mistake: Mistake) -> None:
    n = model.chain.n_joints
    if table.q.shape[1] != n:
        raise InputError(
            f"{table.source} has {table.q.shape[1]} joint columns, but robot "
            f"'{model.chain.name}' has {n} joints"
        )
    for name in ("q", "position", "rotation", "distance", "force", "torque", "sigma"):
        values = getattr(table, name)
        if values is not None and not np.isfinite(values).all():
            k = int(np.argwhere(~np.isfinite(values))[0][0])
            raise InputError(f"{table.source}, line {table.row[k]}: {name} is not finite")
    check_limits(model, table, mistake)
    _check_units(model, table)


def check_limits(model: Model, table: Measurements, mistake: Mistake | None = None) -> None:
    wound = np.abs(table.q[:, model.chain.turning]) > 4 * np.pi
    if wound.any():
        (i, *more), remedy = np.flatnonzero(wound.any(axis=1)).tolist(), "correct the line"
        if 2 * len(more) >= len(table) - 1:
            remedy = "these are probably degrees in a column named …_rad: rename it to …_deg"
        raise InputError(
            f"{table.source}, line {table.row[i]}: a joint stands at "
            f"{rounded(np.abs(table.q[i]).max(), 4)} rad, more than two turns ({1 + len(more)} of "
            f"{len(table)} lines); {remedy}"
        )
    if (beyond := beyond_limits(model.cell, model.chain, table.q, OVERSHOOT, 4)) is not None:
        rows, _, told = beyond
        hint = "" if mistake is None else mistake(model, table)
        if not hint and 2 * len(rows) > len(table):
            hint = "most lines are beyond: probably degrees given as radians (or the reverse), or "
            hint += "another zero of the joint or another robot"
        raise InputError(
            f"{table.source}, line {table.row[rows[0]]}: {told} ({len(rows)} of {len(table)} "
            f"lines); {hint or 'correct the line or the limits'}"
        )


def _check_units(model: Model, table: Measurements) -> None:
    if table.position is None:
        return
    if len(table) > SOME:  # some of many readings tell it as well
        table = table.take(np.linspace(0, len(table) - 1, SOME).astype(np.int64))
    flange, position = model.rigid.flange_poses(table), np.asarray(table.position)
    reach = float(np.linalg.norm(np.ptp(flange[:, :3, 3], axis=0)))
    extent = float(np.linalg.norm(np.ptp(position, axis=0)))
    if reach < SAME or extent < SAME:
        return
    ratio = extent / reach
    # That of most: one that is far off, as by a slip of the key, tells of no unit.
    usual = 2 * np.median(np.linalg.norm(position - np.median(position, axis=0), axis=1)) / reach
    small = ratio >= 3 and "prismatic" not in model.chain.kinds
    if small and np.abs(table.q).max() <= SMALL_ANGLE and (
        # The arm hardly moves, and turned back it moves as measured.
        1 / 3 < extent / _reach(model, replace(table, q=np.degrees(table.q))) < 3
    ):  # fmt: skip
        cause = "the joint angles are probably radians in columns named …_deg: rename to …_rad"
    elif (unit := _unit_of(flange, position, table.marker, reach)) is not None:
        factor, cause = unit
        cause = f"the positions are probably {cause}: convert them (elastocal import), or multiply "
        cause += f"them by {factor:g}"
    elif ratio > EXTENT_FACTOR and usual > EXTENT_FACTOR:
        cause = "the positions are probably millimetres in columns named …_m: rename to …_mm"
    elif ratio < 1 / EXTENT_FACTOR:
        cause = "the positions are probably metres in columns named …_mm: rename to …_m"
        if model.observe == "deflection" and table.force.any(axis=1).all():
            cause = "give positions with and without load: observe = 'deflection' subtracts them"
    else:
        return
    raise InputError(
        f"{table.source}: the readings extend over {rounded(extent * 1e3, 4)} mm, but the nominal "
        f"arm's flange moves over {rounded(reach * 1e3, 4)} mm at these joint values; {cause}"
    )


# By what readings of the same shape as the nominal arm's places may have to be multiplied.
CONVERTED = {
    10.0: "centimetres in columns named …_mm", 25.4: "inches in columns named …_mm",
    0.01: "centimetres in columns named …_m", 0.0254: "inches in columns named …_m",
}  # fmt: skip
OF_A_UNIT = 0.25  # a unit in the place of another is told from the arm's length to a quarter
ALIKE = 0.05  # of the arm's reach: what its own errors leave of a likeness


def _unit_of(
    flange: Array, position: Array, marker: IntArray, reach: float
) -> tuple[float, str] | None:
    some = np.unique(np.linspace(0, len(marker) - 1, SAMPLE).astype(int))
    found = LinearFits(flange[None, some], position[some], marker[some])
    near = (u for u in CONVERTED.items() if abs(found.scale[0] / u[0] - 1) < OF_A_UNIT)
    return next(near, None) if found.left[0] < ALIKE * reach else None


FITS = 0.03  # m, which nominal arms keep to their readings; wrong signs and units are far more
FAR_OFF = 10.0  # times the median, which is more than any noise is


def nothing_shown(observed: Observations, residual: Array) -> InsufficientDataError:
    """Why no parameter moves the readings by more than what is left of them, `residual` (rows,):
    one that is far off hides them all, or the poses show none."""
    far = np.linalg.norm(residual.reshape(-1, observed.size)[:, :3], axis=1)
    told = "the readings do not depend on any parameter of the model; measure other poses or loads,"
    told += " or choose other effects"
    if (off := float(np.median(far))) > FITS:
        told = f"no parameter shows beside readings that lie {length(off)} (median) from the model "
        told += f"as it is held: check {option('fixed')} and [model.nominal] base_position_m, or "
        told += "fit base_frame and marker_position"
    elif far.max() > FAR_OFF * off:
        line = observed.table.row[observed.lead[far.argmax()]]
        told = f"no parameter shows beside the reading of line {line}, which is "
        told += f"{length(far.max())} off: correct it, or drop it"
    return InsufficientDataError(f"{observed.table.source}: {told}")


def _reach(model: Model, table: Measurements) -> float:
    return float(np.linalg.norm(np.ptp(model.rigid.flange_poses(table)[:, :3, 3], axis=0)))


def fixed_and_free(model: Model, fixed: tuple[str, ...]) -> IntArray:
    """Indices of the parameters to fit; `fixed` names parameters, places or effects to hold.
    InputError for a name that is none of these, or when nothing is left."""
    held = set()
    for name in fixed:
        if not (match := model.meant_by(name)):
            raise InputError(
                f"{option('fixed', name)}: the model has no such parameter, place or effect"
                f"{did_you_mean(name, model.all_names)}"
            )
        held |= set(match)
    free = np.array([i for i in range(len(model.parameters)) if i not in held], dtype=np.int64)
    told = "nothing is left to identify; choose effects with parameters in [model] effects, or hold"
    require(len(free), f"{model.cell.source}: {told} fewer by {option('fixed')}")
    return free


def ordinary(model: Model, free: IntArray) -> IntArray:
    """Those of the parameters `free` that no smooth function consists of; InputError where none
    are."""
    found = free[~model.shrunk[free]]
    told = "nothing but smooth functions is left to identify; add base_frame and marker_position to"
    require(len(found), f"{told} [model] effects, or free some parameters")
    return found


# Readings that are copies of others.
#
# A repeat differs from its first reading by the noise.  It agrees to the last digit only where
# that is rounded more coarsely than the noise, and then more often in one coordinate than in all.

NO_FINER = 1e-7  # m; readings with more digits than this agree in all of them by no chance
ROUNDS = 20  # of the equation for P
COPIED = 0.01  # p-value below which equal readings are too many for rounding


def copied(observed: Observations) -> BoolArray:
    """Observations (N,) that repeat an earlier one to the last digit: joint values, load, marker
    and reading, whatever they are called.

    Where readings are rounded, those of one pose, load and marker that differ tell how often a
    coordinate agrees by rounding (with half a reading more of either kind): of pairs that differ
    somewhere, a share s_a = (p_a - P)/(1 - P) agrees in coordinate a, P the product of all p_a.
    Equal readings that are no more frequent than P explains are true repeats.
    """
    table, n = observed.table, len(observed.lead)
    value, own = observed.value.reshape(n, observed.size), observed.lead
    if observed.kind == "pose" and table.rotation is not None:  # its value has zeros there
        value = np.hstack([value[:, :3], table.rotation[own]])
    said = [table.q, table.force, table.marker[:, None]]
    said += [] if table.torque is None else [table.torque]
    key = np.column_stack(said)[own].T
    _, code, count = np.unique(value[:, 0], return_inverse=True, return_counts=True)
    alike = np.flatnonzero(count[code] > 1)  # of a large table few
    whole, found = numbered(*value[alike].T, *key[:, alike]), np.zeros(n, dtype=bool)
    found[alike] = np.unique(whole, return_index=True)[1][whole] != np.arange(len(alike))
    steps = value[:, :3] / NO_FINER
    if not found.any() or np.abs(steps - np.round(steps)).max() > 1e-3:
        return found
    group = numbered(*key)
    size = np.bincount(group)
    first = np.unique(group, return_index=True)[1][group]
    others = np.flatnonzero(first != np.arange(n))
    same = value[others] == value[first[others]]
    differing = same[~same.all(axis=1)]
    partly = (differing.sum(axis=0) + 0.5) / (len(differing) + 1)
    share = 0.0
    for _ in range(ROUNDS):
        share = float(np.prod(partly * (1 - share) + share))
    # A reading with k others before it is like one of them with probability 1 - (1 - P)^k.
    alike_by_chance = np.cumsum(1 - (1 - share) ** np.arange(int(size.max())))[size - 1]
    chance = special.gammainc(int(found.sum()), float(alike_by_chance.sum()))
    return found & bool(chance < COPIED)


FEWEST_VISITS = 3  # in which two markers have to agree: two may by chance of a fixed arm
# Scatter of the distance of two markers (m) that no instrument is below which reads each for
# itself; software of motion capture moves a rigid body to all its markers and writes that.
SOLVED = 2e-6
CLEARLY_LESS = 10.0  # times the scatter, from which the readings' error is not that of the points


def without_copies(table: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """The table without markers that repeat another one's readings to the last digit, and a
    sentence for each."""
    if table.position is None or len(table.marker_names) < 2:
        return table, ()
    points, told, copies = _by_visit(table), [], set[int]()
    for a, b in combinations(range(len(table.marker_names)), 2):
        both = np.isfinite(points[:, [a, b], 0]).all(axis=1)
        if a in copies or both.sum() < FEWEST_VISITS:
            continue
        if (points[both, a] == points[both, b]).all():
            copies.add(b)
            one, other = table.marker_names[a], table.marker_names[b]
            told.append(
                f"marker {other} has the readings of {one} in all {both.sum()} visits: it was left "
                f"out. Look for the column that was copied, and bring the readings of {other}"
            )
    if not copies:
        return table, ()
    return table.take(~np.isin(table.marker, list(copies))), tuple(told)


def solved_body(table: Measurements, error: float) -> str | None:
    """That three or more markers are points of one solved body, where they are; `error` (m) is the
    rms of a reading's residual per axis."""
    if table.position is None or len(table.marker_names) < 3:
        return None
    points = _by_visit(table)
    points = points[np.isfinite(points[:, :, 0]).sum(axis=1) >= 3]
    if len(points) < FEWEST_VISITS:
        return None
    pairs = np.array(list(combinations(range(points.shape[1]), 2)))
    apart = np.linalg.norm(points[:, pairs[:, 0]] - points[:, pairs[:, 1]], axis=2)
    used = np.isfinite(apart).sum(axis=0) >= FEWEST_VISITS
    if not used.any():
        return None
    scatter = float(np.sqrt(np.nanvar(apart[:, used], axis=0).max()))
    if scatter > SOLVED or error < CLEARLY_LESS * scatter:
        return None
    names = [table.marker_names[m] for m in np.unique(pairs[used])]
    within = max(scatter * 1e6, 0.01)
    return (
        f"markers {listed(names)} keep their distances to within {rounded(within, 2)} µm: they are "
        "points of one solved rigid body. A visit carries its pose, six independent "
        f"numbers and not {3 * len(names)}: import the body's pose and set [model] observe = "
        '"pose", or keep one marker'
    )


def _by_visit(table: Measurements) -> Array:
    """Positions (visits, markers, 3) of the first reading of each; NaN where there is none."""
    assert table.position is not None
    visit = visits(table)
    out = np.full((int(visit.max(initial=-1)) + 1, len(table.marker_names), 3), np.nan)
    out[visit[::-1], table.marker[::-1]] = table.position[::-1]
    return out


# Which way is down: whether the arm stands in the readings' frame as the cell says it does.

# Floors, pedestals and trackers are levelled to a degree; what is farther off is another frame.
FALLEN = np.radians(20.0)
AXES = ("x", "y", "z")


def as_placed(model: Model, x: Array) -> Cell:
    """The model's cell with the base turned as it is at x (parameters,)."""
    vector = [v for p, v in zip(model.parameters, x, strict=True)
              if p.effect == BaseFrame.name and p.unit == "rad"]  # fmt: skip
    if len(vector) != 3:
        return model.cell
    turned = ca.evalf(rotation_from_vector(vector)).full()
    nominal = replace(model.cell.model.nominal, base_rotation=turned)
    return replace(model.cell, model=replace(model.cell.model, nominal=nominal))


@dataclass(frozen=True)
class Fallen:
    """An arm whose base lies `angle` rad from how the cell mounts it; `up` (3,) is the direction
    in the readings' frame that is up where it stands as the cell says."""

    angle: float
    up: Array

    @property
    def axis(self) -> str | None:
        near = np.arccos(min(np.abs(self.up).max(), 1.0)) <= FALLEN
        return self.columns[2] if near else None

    @property
    def columns(self) -> list[str]:
        return [("−" if row.sum() < 0 else "") + AXES[int(np.argmax(np.abs(row)))]
                for row in self.turn]  # fmt: skip

    @property
    def turn(self) -> Array:
        """R (3, 3) from the readings' frame to one whose z is that axis."""
        k, eye = int(np.argmax(np.abs(self.up))), np.eye(3)
        axis, across = np.sign(self.up[k]) * eye[k], eye[(k + 1) % 3]
        return np.round(np.stack([across, np.cross(axis, across), axis]))

    def turned(self, table: Measurements) -> Measurements:
        """The table in that frame; forces stay, which are down by the cell's own word."""
        R, rotation, sigma = self.turn, table.rotation, table.sigma
        if rotation is not None:
            Rotation = scipy.spatial.transform.Rotation
            rotation = (Rotation.from_matrix(R) * Rotation.from_rotvec(rotation)).as_rotvec()
        if sigma is not None and table.sigma_frame == "cartesian":
            sigma = sigma @ np.abs(R).T
        position = None if table.position is None else table.position @ R.T
        return replace(table, position=position, rotation=rotation, sigma=sigma)

    def __str__(self) -> str:
        text = (
            f"the fitted base lies {np.degrees(self.angle):.0f}° from how the cell mounts it, and "
            "weights and loads act along −z of the readings' frame"
        )
        if self.axis is None:
            return f"{text}. State how the arm is mounted, [model.nominal] base_rpy_deg"
        return (
            f"{text}. If it is mounted as stated, {self.axis} of that frame points up: write the "
            f"columns {', '.join(self.columns)} as x, y, z; else state [model.nominal] base_rpy_deg"
        )


def turned_base(model: Model, observed: Observations, residual: Array) -> str | None:
    """That the positions show the base turned, by an angle that moves deflections by more than
    their `residual` (rows,) m, where the cell alone says how it stands."""
    table, stated = observed.table, model.cell.model.nominal.base_rotation
    placed = any(p.effect == BaseFrame.name for p in model.parameters)
    if model.observe != "deflection" or table.position is None or placed:
        return None
    light = table.take(np.flatnonzero(~table.force.any(axis=1)))
    if len(np.unique(light.q, axis=0)) < FEWEST_VISITS:
        return None
    Rotation, found = scipy.spatial.transform.Rotation, Registration.of(model, light)
    off = Rotation.from_matrix(found.rotation.T @ (np.eye(3) if stated is None else stated))
    if found.error > FITS or off.magnitude() * observed.value.std() < residual.std():
        return None
    rpy = [rounded(v, 4) for v in np.degrees(rpy_from_rotation(found.rotation))]
    return (
        f"the positions show the base turned by {np.degrees(off.magnitude()):.1f}° from how the "
        "cell mounts it, so that deflections and loads count along wrong axes: state "
        f"[model.nominal] base_rpy_deg = [{', '.join(rpy)}], or fit base_frame"
    )


def fallen(model: Model, x: Array) -> Fallen | None:
    """The arm at x (parameters,), where its base lies far from upright; None where it does not, or
    no base was fitted."""
    if (placed := as_placed(model, x)) is model.cell:
        return None
    stated, found = (c.model.nominal.base_rotation for c in (model.cell, placed))
    mounted = np.eye(3) if stated is None else np.asarray(stated)
    up = np.asarray(found) @ mounted.T[:, 2]
    angle = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    return Fallen(angle, up) if angle > FALLEN else None
