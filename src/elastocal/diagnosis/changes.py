"""What has changed between two calibrations of one arm, and whether chance could have done it.

With x₁, x₂ the parameters of the arm itself in two campaigns (base, markers and instrument are set
up anew each time and count for neither) and V₁, V₂ their covariances,

    z = x₂ − x₁,    Cov z = V₁ + V₂,

since two campaigns err independently.  V is that of the noise model, N, where what is known of the
noise explains the residual.  Else part of it is what the model lacks, larger at some poses than at
others, and V is the `scatter` of configurations (CR2), which are drawn anew in each campaign.

Each alone: |z_k| / s_k against Student's t with Welch and Satterthwaite's degrees of freedom ν_k,
and by Holm's rule, so that with probability 1 − level no parameter is called changed that is not.
All together, without inverting a V that few configurations tell, zᵀ N⁻¹ z / tr C against
F(tr² C / tr C², ν), C = N^-½ V N^-½, of p where V is N (Box 1954; Brunner, Dette and Munk 1997, J.
Am. Stat. Assoc. 92, 1494); ν^-½ is the mean of ν_k^-½, as of variances that err together.  The
coefficients of a smooth function are one thing, tested together as all of z are.

A campaign determines sums: a parameter with shares M of those that its poses do not tell from it,

    y_i = A_i X + ε_i,   A_i = [1 M_i],   ε_i ~ N(0, V_i),   X ~ N(nominal, typical²),

so that other poses move estimates without any change.  With y₂ = A₂ (X + z) + ε₂, ẑ and Cov ẑ are
those of least squares, whatever both determined; a parameter that one campaign alone determined is
told where the data say more of its change than its typical size does.  Set-up that was left open
counts as noise of each.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, special

from elastocal.above import Result, checked_arguments
from elastocal.diagnosis.diagnosis import NORMAL_95
from elastocal.identification.least_squares import correlations, variance_of
from elastocal.identification.noise_summary import holm
from elastocal.identification.result import Calibration
from elastocal.identification.solve import WORTH_A_COLUMN
from elastocal.identification.weighted_problem import moved
from elastocal.messages import InsufficientDataError, listed, option, require, size_of
from elastocal.model.calibrated import (
    CalibratedArm,
    CalibratedTool,
    Conditions,
    ToolPoint,
    arm_with,
    random_table,
    unstated_needs,
)
from elastocal.model.effects.base import given_force
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import smooth_groups
from elastocal.units import Array, BoolArray, IntArray

SCHEMA = "elastocal/comparison/1"
LEVEL = 0.05  # chance that anything is called changed where nothing is
UNKNOWN = 1e3  # standard deviations of an estimate: its parameter has no typical size
TIED = 1e-13  # least eigenvalue of correlations: below, constraints fix a sum
SAME = 1e-3 / TIED**0.5  # in its deviations, of the difference of two such sums
STANDS_FOR = 0.1  # of the largest deviation in a sum: a part of it
CENTRAL = 0.95
NAMED = 4  # parameters in a message
BY_ONE = "one session alone shows it"
MOST_POSES = 100_000


@dataclass(frozen=True)
class ParameterChange:
    """One parameter: values and their difference in SI units, its standard deviation, p alone and
    by Holm's rule, whether that is below the level, and `moves`: rms in m at the tool.  Where no
    reading told it from others, `combined_with`, the values are those of their sum.  Of a smooth
    function values, difference and its deviation are rms in m at the tool."""

    name: str
    unit: str
    old: float
    new: float
    change: float
    std: float
    p: float
    p_family: float
    changed: bool
    moves: float
    combined_with: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(Result):
    """What has changed between two calibrations of one arm.

    Attributes:
        old, new: The two arms.
        changes: One for each parameter of the arm that both campaigns determine.
        p: Chance of differences as large as all of these together where nothing has changed.
        level: Chance that any parameter is called changed where none is.
        moved: (poses, 3) m: how the tool's point moves, commanded alike, set up alike.
        chance: (poses,) m: the standard deviation of that by the campaigns' noise alone.
        place: (poses, 3) m: where the point is, in the data's frame of the old campaign.
        forces: (L, 3) N that act at these poses, in turn.
        loads_of: Where they come from, in words.
        first_order: Whether the campaigns determined other parameters of the arm, of which sums
            were compared, to first order.
        not_compared: What the models have and nothing was compared of, by the reason.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv")
        >>> ec.compare(fit, fit)
        <Comparison kuka_kr270_2: 0 of 9 parameters changed, p = 1.0>
    """

    old: CalibratedArm
    new: CalibratedArm
    changes: tuple[ParameterChange, ...]
    p: float
    level: float
    moved: Array
    chance: Array
    place: Array
    forces: Array
    loads_of: str
    first_order: bool
    not_compared: dict[str, list[str]]

    @property
    def changed(self) -> list[ParameterChange]:
        """Those that exceed their joint uncertainty, the largest at the tool first."""
        return sorted((c for c in self.changes if c.changed), key=lambda c: -c.moves)

    @property
    def verdict(self) -> str:
        """ "changed" (some parameters are named), "changed_somewhere" or "no_change_shown"."""
        if self.changed:
            return "changed"
        return "changed_somewhere" if self.p < self.level else "no_change_shown"

    @property
    def one_result(self) -> bool:
        """Whether both are the same result: no two campaigns agree to the last digit."""
        same = self.old.determined == self.new.determined and np.array_equal(self.old.x, self.new.x)
        return same and np.array_equal(self.old.covariance, self.new.covariance)

    @property
    def distance(self) -> NDArray:
        """How far the point moves (poses,) in m."""
        return np.asarray(np.linalg.norm(self.moved, axis=1))

    def __repr__(self) -> str:
        return (
            f"<Comparison {self.old.model.chain.name}: {len(self.changed)} of "
            f"{len(self.changes)} parameters changed, {size_of(self.p)}>"
        )

    def to_json(self) -> dict[str, Any]:
        """The comparison as a JSON-ready dictionary; parameters in SI units, lengths in µm."""
        far = self.distance * 1e6
        return {
            "schema": SCHEMA,
            "robot": self.old.model.chain.name,
            "old": self.old.source,
            "new": self.new.source,
            "verdict": self.verdict,
            "one_result": self.one_result,
            "p": self.p,
            "level": self.level,
            "family": "Holm over the parameters",
            "changed": [c.name for c in self.changed],
            "parameters": [vars(c) for c in self.changes],
            "first_order": self.first_order,
            "not_compared": [f"{n} ({why})" for why, of in self.not_compared.items() for n in of],
            "tool": {
                "poses": len(far),
                "force_N": self.forces[0] if len(self.forces) == 1 else None,
                "forces_N": self.forces,
                "rms_um": float(np.sqrt(np.mean(far**2))),
                "p95_um": float(np.quantile(far, CENTRAL)),
                "max_um": float(far.max()),
                "by_chance_rms_um": float(np.sqrt(np.mean(self.chance**2))) * 1e6,
            },
        }


@checked_arguments
def compare(
    old: CalibratedArm | Calibration,
    new: CalibratedArm | Calibration,
    *,
    load: ArrayLike | None = None,
    level: float = LEVEL,
    poses: int = 300,
    seed: int = 0,
) -> Comparison:
    """What has changed since the last calibration?

    The parameters of the arm itself, one by one by Holm's rule and all together, and how far the
    tool has moved over the workspace where it is commanded and set up alike.

    Args:
        old: The earlier calibration, or its arm (`fit.arm`, `read_calibrated`).
        new: The later one, of the same cell.
        load: Force (3,) in N at the load point under which the tool is compared; by default the
            loads of the campaigns, in turn.
        level: Chance that any parameter is called changed where none is.
        poses: Random poses within the joint limits.
        seed: Of these poses.

    Returns:
        The `Comparison`: changes with their uncertainty, displacements, the verdict.

    Raises:
        InputError: The two are of different models, or an option is wrong.
        InsufficientDataError: They have no parameter in common, or no pose settles under the load.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv")
        >>> ec.compare(fit, fit).verdict
        'no_change_shown'
    """
    before, after = (a if isinstance(a, CalibratedArm) else a.arm for a in (old, new))
    require(
        2 <= poses <= MOST_POSES,
        f"{option('poses')} takes a whole number from 2 to {MOST_POSES}; found {poses}",
    )
    require(0 < level < 1, f"{option('level')} takes a number between 0 and 1; found {level}")
    # The parameters of the arm itself; base and markers are set up anew in each campaign.
    own, theirs = (
        {p.name for p in arm.model.parameters if not CATALOGUE[p.effect].registered}
        for arm in (before, after)
    )
    other = listed(sorted(own ^ theirs), NAMED)
    require(
        not other,
        f"{before.source} and {after.source} are of two models: one alone has {other}; identify "
        "both with the same effects",
    )
    loads = _loads(before, after, given_force(load))
    return _compared(before, after, own, *loads, float(level), int(poses), int(seed))


def _loads(old: CalibratedArm, new: CalibratedArm, force: Array | None) -> tuple[Array, str]:
    """The forces (L, 3) to compare under and whose they are: those given, else of the earlier
    campaign, in whose frame the tool is compared, the later one, the cell's plan, where any."""
    if force is not None:
        return force[None], "as asked for"
    stated = {"the earlier session": old.loads, "the later session": new.loads,
              "the cell's plan": old.model.cell.design.loads}  # fmt: skip
    for whose, loads in stated.items():
        if loads is not None and loads.any():
            return loads[loads.any(axis=1)], f"those of {whose}"
    return np.zeros((1, 3)), "as no load is stated"


def _compared(
    old: CalibratedArm, new: CalibratedArm, own: set[str], forces: Array, whose: str, level: float,
    poses: int, seed: int,
) -> Comparison:  # fmt: skip
    conditions = Conditions()
    unstated = unstated_needs(old, conditions)
    before = arm_with(old, [name for name, needs in unstated.items() if not needs])
    own = own & {*before.model.names}
    left = defaultdict[str, list[str]](list)
    for name, needs in unstated.items():
        if needs:
            left[f"follows {listed(needs)}"].append(name.replace("_", " "))
    functions: dict[str, str] = {}  # parameter → the smooth function that it is part of
    for group in smooth_groups(before.model):
        keys = {before.model.names[k] for k in group.columns.ravel()}
        functions |= dict.fromkeys(keys, group.name)
        if (keys <= set(old.determined)) != (keys <= set(new.determined)):
            left[BY_ONE].append(group.name)
            own -= keys
    table = random_table(before.model, conditions, poses, seed)
    # Where the tool is predicted to be; what is read there counts for nothing.
    table = replace(table, force=np.resize(forces, (poses, 3)), position=np.zeros((poses, 3)))
    names, z, V, hidden = _difference(old, new, [n for n in before.model.names if n in own])
    if hidden:
        left[BY_ONE] += hidden
    if not names:
        raise InsufficientDataError(
            f"{old.source} and {new.source} determine no parameter of the arm in common; identify "
            "both with the same effects, from poses that show them"
        )
    cell = before.model.cell
    load = cell.tool.load_point
    at = load if load.any() else next(iter(cell.tool.markers.values()), load)
    # The set-up of the old campaign for both.
    columns = np.array([before.model.names.index(name) for name in names])
    tool, tool_moved = (
        CalibratedTool(replace(old, model=before.model, x=x), ToolPoint(at, None, "tool"))
        for x in (before.x, moved(before.x, columns, z))
    )
    rows = tool.rows(table)
    here, there = (each.poses(rows, table.q)[0] for each in (tool, tool_moved))
    settled = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
    if not settled.any():
        raise InsufficientDataError(
            f"none of {poses} random poses has a static equilibrium under the load; check "
            f"{option('load')}"
        )
    B = tool.sensitivity([row[settled] for row in rows], table.q[settled])[..., columns]
    changes, p = _tested(old, new, names, functions, z, V, level, B)
    return Comparison(
        old, new, changes, p, level, (there - here)[settled], np.sqrt(variance_of(B, V[1])),
        here[settled], forces, whose, {*old.determined} & own != {*new.determined} & own,
        dict(left),
    )  # fmt: skip


def _estimates(
    arm: CalibratedArm, own: list[str], beside: CalibratedArm
) -> tuple[IntArray, Array, Array, Array, Array]:
    """Which of the parameters `own` it determined, or limited where the one `beside` determined
    them (k,); y (k,) and A (k, own) with y = A X + ε; N and V (2, k, k) of ε: noise, and what was
    left open of the set-up; and the typical sizes (own,) of those left open, 0 where none is known,
    −∞ for the others.  Raises InputError where the covariance has no numbers."""
    # What constraints fix is held.
    place = {name: i for i, name in enumerate(arm.determined) if arm.covariance[i, i] != 0}
    limits = {str(e["name"]): e["limits95"] for e in arm.entries
              if e.get("limits95") and e["name"] in beside.determined}  # fmt: skip
    known = [k for k, name in enumerate(own) if name in place]
    held = [k for k, name in enumerate(own) if name in limits and name not in place]
    at, ends = [place[own[k]] for k in known], np.reshape([limits[own[k]] for k in held], (-1, 2))
    V = np.stack([arm.covariance, arm.of_campaigns[0]])[:, at][..., at]
    A, values = np.eye(len(own))[known], arm.values
    require(
        bool(np.isfinite(V).all() and (np.diagonal(V, axis1=1, axis2=2) > 0).all()),
        f"{arm.source}: its covariance has no numbers, or negative variances, for "
        f"{', '.join(own[:3])} …; identify anew",
    )
    y, left = np.array([values[own[k]] for k in known]), np.full(len(own), -np.inf)
    # What it limits, and by how much the others would be another for each unit of that.
    limited, off = ends.mean(axis=1), np.zeros((len(held), len(known)))
    open_ = arm.left and zip(arm.left.names, arm.left.mixing[at].T, arm.left.typical, strict=True)
    for name, share, typical in open_ or ():
        k = own.index(name) if name in own else -1
        if k in held:
            off[held.index(k)] = share
            y += share * (values[name] - limited[held.index(k)])
        elif k >= 0:
            A[:, k], left[k] = share, typical
            y += share * values[name]
        else:
            V = V + typical**2 * np.outer(share, share)
    both = np.hstack([-off, np.eye(len(held))]).T * np.ptp(ends, axis=1) / (2 * NORMAL_95)
    V = np.pad(V, ((0, 0), (0, len(held)), (0, len(held)))) + both @ both.T
    A = np.vstack([A, np.eye(len(own))[held]])
    return np.array([*known, *held], dtype=np.int64), np.append(y, limited), A, V, left


def _difference(
    old: CalibratedArm, new: CalibratedArm, own: list[str]
) -> tuple[list[str], Array, Array, list[str]]:
    """Names, ẑ (p,), N and V of it (2, p, p), and which of `own` one campaign alone shows.  Raises
    InputError where a parameter is held at two values, or at one that the other campaign
    contradicts, or a covariance has no numbers."""
    found = (_estimates(arm, own, other) for arm, other in ((old, new), (new, old)))
    (first, y1, A1, V1, left1), (second, y2, A2, V2, left2) = found
    both, alone = np.intersect1d(first, second), np.setxor1d(first, second)
    # What both determined drops out of the differences, whatever it is: T of all estimates.
    of, side = np.append(first, second), np.repeat([-1.0, 1.0], [len(first), len(second)])
    T, A = np.vstack([(both[:, None] == of) * side, alone[:, None] == of]), np.vstack([A1, A2])
    std, nominal = np.zeros(len(own)), old.model.nominal[[*map(old.model.names.index, own)]]
    std[of] = np.sqrt(np.append(np.diag(V1[0]), np.diag(V2[0])))
    values = np.array([[arm.values[name] for name in own] for arm in (old, new)])
    left, away = np.maximum(left1, left2), np.abs(values - nominal).max(axis=0)
    # A session that determined it may have found it larger than typical.
    size = np.where(left > 0, np.hypot(left, away), UNKNOWN * std) * (left >= 0)
    for k in np.flatnonzero((left < 0) & (std == 0)).tolist():
        require(
            math.isclose(*values[:, k]),
            f"{own[k]} is held at {values[0, k]:.6g} in {old.source} and at {values[1, k]:.6g} in "
            f"{new.source}; identify both with the same value",
        )
    G, H = T @ A, T[:, len(first) :] @ A2
    G[:, both] = 0.0
    t = T @ np.append(y1, y2) - G @ nominal
    V = np.stack([T @ linalg.block_diag(*each) @ T.T for each in zip(V1, V2, strict=True)])
    V += (G * size**2) @ G.T
    # What the other held at a value that is no matter of chance, of as many as are held.
    spread, held = np.sqrt(np.diag(V[1])), max(int((size[alone] == 0).sum()), 1)
    most = -float(special.ndtri(LEVEL / held / 2))
    for k, off in zip(alone.tolist(), (t / spread)[len(both) :].tolist(), strict=True):
        one, other = (new, old) if k in first else (old, new)
        require(
            size[k] > 0 or abs(off) < most,
            f"{own[k]} is held in {one.source} at a value from which that of {other.source} is "
            f"{abs(off):.1f} standard deviations away; identify both with it free, or both held",
        )
    white, fixed = _whitener(V[0], TIED)
    require(
        bool((np.abs(white[fixed] @ t) < SAME).all()),
        f"constraints fix a sum of parameters at one value in {old.source} and at another in "
        f"{new.source}; identify both with the same knowledge",
    )
    W, told = white @ H, both.tolist()
    for k in alone.tolist():
        beside = W[:, told]
        off = W[:, k] - beside @ np.linalg.lstsq(beside, W[:, k], rcond=None)[0]
        if np.linalg.norm(off) * size[k] > WORTH_A_COLUMN:
            told.append(k)
    # What one that is told stands for is no less told.
    shares = np.abs(A[np.isin(of, np.intersect1d(alone, told))]) * size
    covered = (shares > STANDS_FOR * shares.max(axis=1, initial=0.0)[:, None]).any(axis=0)
    hidden = [own[k] for k in alone if k not in told and not covered[k]]
    length = np.linalg.norm(W[:, told], axis=0)
    K = np.linalg.pinv(W[:, told] / length) / length[:, None] @ white
    return [own[k] for k in told], K @ t, K @ V @ K.T, hidden


def _whitener(V: Array, least: float) -> tuple[Array, BoolArray]:
    """W (p, p) with W V Wᵀ = I, and which of its rows are sums that constraints fix: an eigenvalue
    of the correlations below `least`, which stands in its place."""
    rho, unit = correlations(V)
    value, axes = np.linalg.eigh(rho)
    return axes.T / unit / np.sqrt(np.maximum(value, least))[:, None], np.asarray(value < least)


def _tested(
    old: CalibratedArm, new: CalibratedArm, names: list[str], functions: dict[str, str], z: Array,
    spread: Array, level: float, B: Array,
) -> tuple[tuple[ParameterChange, ...], float]:  # fmt: skip
    """Each parameter and each smooth function by Holm's rule, and p of all together.  `functions`:
    parameter → that which it is part of; `spread`: N and V (2, p, p) of z; `B` (poses, 3, p) in m
    per unit at the tool."""
    N, V = spread
    std = np.sqrt(np.diag(V))
    (v1, dof1), (v2, dof2) = (_variances(arm, names) for arm in (old, new))
    nu = np.clip((v1 + v2) ** 2 / np.maximum(v1**2 / dof1 + v2**2 / dof2, 1e-300), 1.0, 1e9)
    alone = 2 * special.stdtr(nu, -np.abs(z) / std)

    def together(at: list[int]) -> float:
        white, fixed = _whitener(N[np.ix_(at, at)], 10 * TIED)
        white = white[~fixed]
        C, square = white @ V[np.ix_(at, at)] @ white.T, float(((white @ z[at]) ** 2).sum())
        mean, dof = np.trace(C), float((nu[at] ** -0.5).mean() ** -2)
        return float(special.fdtrc(mean**2 / (C**2).sum(), dof, square / mean))

    def rms(far: Array) -> float:
        return float(np.sqrt((far**2).sum(axis=1).mean()))

    parts: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        parts.setdefault(functions.get(name, name), []).append(k)
    x = np.array([old.values[name] for name in names])
    p = np.array([together(at) if n not in names else alone[at[0]] for n, at in parts.items()])
    units = {q.name: q.unit for q in old.model.parameters}
    others = {str(e["name"]): tuple(e.get("combined_with") or ()) for e in old.entries}
    changes = []
    tests = zip(p.tolist(), holm(p).tolist(), strict=True)
    for (name, at), (single, in_family) in zip(parts.items(), tests, strict=True):
        own, moves = B[..., at], rms(B[..., at] @ z[at])
        if name in units:
            (a, change, sd), unit = (float(v[at[0]]) for v in (x, z, std)), units[name]
            values = a, a + change, change, sd
        else:
            sd, unit = float(np.sqrt(variance_of(own, V[np.ix_(at, at)]).mean())), "m"
            values = rms(own @ x[at]), rms(own @ (x + z)[at]), moves, sd
        changes.append(ParameterChange(
            name, unit, *values, single, in_family, in_family < level, moves, others.get(name, ()),
        ))  # fmt: skip
    return tuple(changes), together(list(range(len(z))))


def _variances(arm: CalibratedArm, names: list[str]) -> tuple[Array, Array]:
    """Variances (p,) and their degrees of freedom; 0 of what it did not determine."""
    V, dof = arm.of_campaigns
    each = dict(zip(arm.determined, zip(np.diag(V), dof, strict=True), strict=True))
    v, nu = np.array([each.get(name, (0.0, np.inf)) for name in names]).T
    return v, nu
