"""What a file holds of an arm, fitted to all that the arm does where it was measured.

A calibration estimates geometry and springs beside the effects that a format lacks, so that without
these they are no longer the best.  With p the positions of flange origin and markers at the visits
measured and at more poses within their ranges, y base, geometry and springs of the file, and c the
coefficients of a joint correction f (`JointCorrection`) where one is asked for,

    min over y, c of  Σ |p_file(y, f(q; c)) − p_arm(q)|² / σ² + Σ ((y − x) / size)² + Σ (c / size)²,

x the values identified and σ the rms that is left: what the positions do not show stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from elastocal.cell.arm_description import EffectChoice, Tool
from elastocal.errors import InputError, require
from elastocal.export.exportable import Kept, evaluate_pieces, points_of
from elastocal.files import read_text
from elastocal.measurements import Measurements
from elastocal.model.arm import row_inputs
from elastocal.model.calibrated import Valued, random_table, table_at
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.gears import JointOffset
from elastocal.model.effects.placements import LinkGeometry
from elastocal.model.evaluate import BatchFunction
from elastocal.model.manipulator import Model
from elastocal.model.symbolic import SymbolicArm
from elastocal.tables import csv_text
from elastocal.units import Array, IntArray

HEADER = ("joint", "follows", "position", "delta")
JOINT, SIDE = "joint", "approach"
MOST_BYTES = 50_000_000
SEEN = 1e-7  # rad or m: a curve that stays below moves a tool by 0.1 µm in a metre


@dataclass(frozen=True)
class CorrectionCurve:
    """`delta` (k,) rad or m that joint `joint` (0-based) stands beyond its command, against
    `position` (k,) of what it `follows`: "joint2" in rad or m, or "approach2", -1 or 1."""

    joint: int
    follows: str
    position: Array
    delta: Array


@dataclass(frozen=True)
class JointCorrection:
    """q_effective,j = q_j + Σ_i g_ji(q_i) + Σ_i s_ji a_i, a_i = ±1 the direction of joint i's last
    motion: where an exported arm is to be commanded so that it stands where the real one does when
    commanded to q.  Curves are linear between their rows and constant beyond.

    Examples:
        >>> from elastocal.export.refit import read_joint_correction
        >>> effective = read_joint_correction("joints.csv")
        >>> effective([0.4, -1.0, 1.0, 0.0, 0.5, 0.0]).round(3)
        array([ 0.4, -1. ,  1. ,  0. ,  0.5,  0. ])
    """

    curves: tuple[CorrectionCurve, ...]

    def __call__(self, q: ArrayLike, approach: ArrayLike | None = None) -> NDArray:
        """Joints to command (joints,) or (n, joints); without `approach`, like q, no curve that
        follows it counts."""
        given = np.asarray(q, dtype=float)
        sides = np.zeros_like(given) if approach is None else np.asarray(approach, dtype=float)
        found = given.copy()
        for curve in self.curves:
            kind = SIDE if curve.follows.startswith(SIDE) else JOINT
            at = (sides if kind == SIDE else given)[..., int(curve.follows[len(kind) :]) - 1]
            found[..., curve.joint] += np.interp(at, curve.position, curve.delta)
        return found

    def merged(self) -> JointCorrection:
        """The same with one curve for each joint and what it follows, without those too small to
        be seen."""
        alike: dict[tuple[int, str], list[CorrectionCurve]] = {}
        for curve in self.curves:
            alike.setdefault((curve.joint, curve.follows), []).append(curve)
        found = []
        for (joint, follows), parts in sorted(alike.items()):
            x = np.unique(np.concatenate([part.position for part in parts]))
            total = sum((np.interp(x, p.position, p.delta) for p in parts), np.zeros(len(x)))
            if np.abs(total).max() > SEEN:
                found.append(CorrectionCurve(joint, follows, x, total))
        return JointCorrection(tuple(found))

    def csv(self, comments: Sequence[str] = ()) -> str:
        """The table as text; positions and deltas in rad, of prismatic joints in m."""
        return csv_text(HEADER, self._rows(), comments)

    def _rows(self) -> Iterator[tuple[str, ...]]:
        for curve in self.curves:
            for position, delta in zip(curve.position, curve.delta, strict=True):
                name = f"{JOINT}{curve.joint + 1}"
                yield name, curve.follows, f"{position:.6g}", f"{delta + 0.0:.4e}"


def read_joint_correction(path: str | Path) -> JointCorrection:
    """The correction that `export --joint-correction` wrote."""
    lines = [
        line
        for line in read_text(path, "joint correction", MOST_BYTES).splitlines()
        if line[:1] != "#"
    ]
    require(
        bool(lines) and lines[0] == ",".join(HEADER),
        f"{path}: its columns are not {', '.join(HEADER)}; give the file that export wrote",
    )
    rows: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            name, follows, position, delta = line.split(",")
            int(name.removeprefix(JOINT)), int(follows.removeprefix(JOINT).removeprefix(SIDE))
            rows.setdefault((name, follows), []).append((float(position), float(delta)))
        except ValueError:
            raise InputError(
                f"{path}, row {number}: '{line}' is no joint, what it follows and two numbers; "
                "export it anew"
            ) from None
    return JointCorrection(
        tuple(
            CorrectionCurve(int(name.removeprefix(JOINT)) - 1, follows, *np.array(pairs).T)
            for (name, follows), pairs in rows.items()
        )
    )


# A joint correction: q_effective = f(q_commanded).

GEOMETRY = (JointOffset.name, LinkGeometry.name)  # which every format holds
STEPS = 4  # errors of millimetres are nearly linear
SMALLEST = 1e-9  # m
# Poses besides the visits, where the arm is as well known and the file has as much freedom: of few
# visits alone the fit would follow each.  The curves of a correction have several hundred
# coefficients.
MORE, MORE_OF_CURVES = 300, 700
MOVED = 0.01  # rad or m: a joint that was held still has no curve
KNOTS = 13  # of what goes with another joint's angle, over its range measured
FINE = np.radians(0.5)  # steps of what the gears of a joint do: 6 to a wave of 120 per turn
SLOPPY = 3e-4  # rad (an arc minute) or m: typical size of a joint's correction


@dataclass(frozen=True)
class Refit:
    """Distance in m, rms over the markers, from the calibrated arm: of the file as identified
    (`before`), of the file that was written (`after`), of the nominal arm with base and tool
    placed, of the file with its joint `correction` (None where there is none); at `poses` random
    poses within the ranges of the `visits` measured, under their loads."""

    before: float
    after: float
    nominal: float
    correction: float | None
    poses: int
    visits: int

    @property
    def taken(self) -> bool:
        """Whether the file has what was fitted; else nothing is better than what was identified."""
        return self.after < self.before

    def to_json(self) -> dict[str, Any]:
        sizes = {"before": self.before, "after": self.after, "nominal": self.nominal}
        told = {f"marker_rms_{name}_um": size * 1e6 for name, size in sizes.items()}
        corrected = None if self.correction is None else self.correction * 1e6
        return {
            "taken": self.taken, **told, "marker_rms_with_correction_um": corrected,
            "poses": self.poses, "visits": self.visits,
        }  # fmt: skip


def refitted(
    kept: Kept, poses: int, seed: int, correct: bool = False
) -> tuple[Kept, Refit | None, JointCorrection]:
    """`kept` with what the file holds fitted at the visits of its conditions, the errors, and with
    `correct` what joints are to be commanded besides.

    `kept` as it is, and no errors, where no visits are known, or where the file holds all of the
    arm, or where no geometry was calibrated and no correction is asked for.
    """
    conditions, part = kept.conditions, kept.exported
    own, visits = part.model.cell.model.effects, conditions.visits
    lacks = any(omission.without is not None for omission in kept.omissions)
    geometry = bool({choice.name for choice in own} & set(GEOMETRY))
    if visits is None or not lacks or not (geometry or correct):
        return kept, None, JointCorrection(())
    rng, model = np.random.default_rng(seed), kept.full.model
    check = random_table(model, conditions, poses, seed)
    more = random_table(model, conditions, MORE_OF_CURVES if correct else MORE, seed + 1)
    q, force = np.vstack([visits.q, more.q]), np.vstack([visits.force, more.force])
    fit = _ArmFit(kept, table_at(model, conditions, q, force, rng))
    others = [choice for choice in own if choice.name not in GEOMETRY]
    whole = _with(part, [*others, *map(EffectChoice, GEOMETRY)])
    start = _gears(kept) if correct else JointCorrection(())
    best, curves = fit.arm(whole, start, geometry, correct)
    placed = [choice for choice in own if effect_of(choice.name).registered]
    nominal, _ = fit.arm(_with(part, placed), JointCorrection(()), False, False, tool=True)
    before, alone, worst = (_rms(kept, each, check, check) for each in (part, best, nominal))
    corrected = _rms(kept, best, check, _commanded(check, curves)) if correct else None
    after = alone if correct else min(before, alone)
    found = Refit(before, after, worst, corrected, poses, len(visits.q))
    return (replace(kept, exported=best, fitted=True) if after == alone else kept), found, curves


def _with(part: Valued, effects: Iterable[EffectChoice], tool: Tool | None = None) -> Valued:
    cell, values, chosen = part.model.cell, part.values, tuple(effects)
    spec = replace(cell.model, effects=chosen)
    if not any(effect_of(choice.name).elastic for choice in chosen):
        spec = replace(spec, compliance_levels={})
    model = Model.assembled(part.model.chain, replace(cell, model=spec, tool=tool or cell.tool))
    return Valued(model, np.array([values.get(p.name, p.nominal) for p in model.parameters]))


def _commanded(table: Measurements, correction: JointCorrection) -> Measurements:
    return replace(table, q=correction(table.q, table.approach))


def _rms(kept: Kept, part: Valued, table: Measurements, commanded: Measurements) -> float:
    """Distance in m, rms over markers and poses, of the markers of `part`, commanded to other
    joints, from those of the arm."""
    markers = (evaluate_pieces(arm, kept.conditions).points[1:] for arm in (kept.exported, part))
    expected = points_of(kept.full, table, next(markers))
    apart = np.linalg.norm(points_of(part, commanded, next(markers)) - expected, axis=2)
    return float(np.sqrt(np.mean(apart[np.isfinite(apart).all(axis=1)] ** 2)))


def _gears(kept: Kept) -> JointCorrection:
    """What the transmissions that the file lacks add to each joint, against each joint's angle, the
    others in the middle of what was measured: the whole of it but for what goes with a load."""
    full, conditions = kept.full, kept.conditions
    held = {choice.name for choice in kept.exported.model.cell.model.effects}
    own = [c for c in full.model.cell.model.effects if c.name not in held]
    part = _with(full, [c for c in own if effect_of(c.name).stage == "transmission"])
    chain, cell = part.model.chain, part.model.cell
    symbolic = SymbolicArm(chain, cell)
    arm = symbolic.arm
    motion = ca.vertcat(*arm.q) - arm.q_commanded
    function = BatchFunction([*arm.inputs.values(), symbolic.p], [motion])
    assert conditions.visits is not None
    middle = np.median(conditions.visits.q, axis=0)
    curves = []
    ranges = zip(*finite_ranges(chain, *joint_limits(cell, chain)), strict=True)
    for i, (low, high) in enumerate(ranges):
        x = np.linspace(low, high, int(np.ceil((high - low) / FINE)) + 1)
        q = np.tile(middle, (len(x) + 1, 1))
        q[1:, i] = x
        rng = np.random.default_rng(0)
        table = table_at(part.model, conditions, q, np.zeros(3), rng)
        still = np.zeros(q.shape)  # of no direction, though the joints have moved before
        table = replace(table, approach=still, direction=still + 1e-12, move=still)
        moved = np.broadcast_to(function(*row_inputs(arm, table), part.x)[0][..., 0], q.shape)
        curves += [
            CorrectionCurve(j, f"joint{i + 1}", x, moved[1:, j] - (moved[0, j] if j != i else 0.0))
            for j in range(len(middle))
        ]
    return JointCorrection(tuple(curves)).merged()


class _ArmFit:
    """Fits to where `kept.full` has points of its tool at the poses of a table."""

    def __init__(self, kept: Kept, table: Measurements) -> None:
        self.kept, self.table = kept, table
        assert kept.conditions.visits is not None
        self.measured = kept.conditions.visits.q

    def arm(
        self, part: Valued, start: JointCorrection, geometry: bool, correct: bool,
        tool: bool = False,
    ) -> tuple[Valued, JointCorrection]:  # fmt: skip
        """`part` and its joint correction, fitted: base and springs, with `geometry` that, with
        `tool` the markers, with `correct` more than `start` of the correction.  The flange's origin
        counts as a marker where the tool is not fitted."""
        pieces = evaluate_pieces(part, self.kept.conditions)
        places = {name: T[:3, 3] for name, T in pieces.markers.items()}
        free = part
        if not tool:  # it is the same in both: its points are fixed in the flange frame
            places = {"flange": np.zeros(3)} | places
            own = [c for c in part.model.cell.model.effects if effect_of(c.name).stage != "tool"]
            free = _with(part, own, Tool(part.model.cell.tool.load_point, places))
        target = points_of(self.kept.full, self.table, np.array(list(places.values())))
        x, correction = self._least_squares(free, target, start, geometry, correct)
        values = part.values | dict(zip(free.model.names, x, strict=True))
        return replace(part, x=np.array([values[n] for n in part.model.names])), correction

    def _least_squares(
        self, part: Valued, target: Array, start: JointCorrection, geometry: bool, correct: bool
    ) -> tuple[Array, JointCorrection]:
        """Values (parameters,) and correction that put the markers closest to `target` (poses,
        markers, 3)."""
        model, x = part.model, part.x.copy()
        ends = _commanded(self.table, start)
        settled = np.isfinite(target).all(axis=(1, 2))
        settled &= np.isfinite(model.flange_poses(ends, x)).all(axis=(1, 2))
        rows = self._rows(np.flatnonzero(settled), tuple(model.cell.tool.markers))
        free = [k for k, p in enumerate(model.parameters) if _is_free(p.effect, geometry)]
        turns = [k for k, p in enumerate(model.parameters) if p.effect == JointOffset.name]
        asked = np.array(sorted({*free, *(turns if correct else ())}), dtype=np.int64)
        mine = np.searchsorted(asked, free)
        curves = _Curves(rows, self.measured) if correct else None
        size = curves.count if curves else 0
        lower = [model.parameters[k].lower for k in free] + [None] * size
        u = np.concatenate([x[free], np.zeros(size)])
        first, least = u.copy(), np.array([-np.inf if low is None else low for low in lower])
        sizes = np.zeros(0)
        for _ in range(STEPS):
            correction = start if curves is None else curves.correction(start, u[len(free) :])
            regression = model.regressor(_commanded(rows, correction), x, asked)
            r, B = target[settled].ravel() - regression.prediction, regression.B[:, mine]
            if not sizes.size:
                whole = np.zeros((len(r), len(x)))
                whole[:, free] = B
                sizes = np.concatenate([model.sizes(whole)[free], np.full(size, SLOPPY)])
            if curves is not None:
                at = np.searchsorted(asked, turns)
                B = np.hstack([B, curves.columns(regression.B[:, at])])
            sigma = max(float(np.sqrt(np.mean(r**2))), SMALLEST)
            u = u + _step(B / sigma, r / sigma, sizes, u - first, least - u)
            x[free] = u[: len(free)]
        return x, start if curves is None else curves.correction(start, u[len(free) :])

    def _rows(self, poses: IntArray, names: tuple[str, ...]) -> Measurements:
        at = np.repeat(poses, len(names))
        marker = np.tile(np.arange(len(names)), len(poses))
        return replace(
            self.table.take(at), marker=marker, marker_names=names, position=np.zeros((len(at), 3))
        )


def _is_free(effect: str, geometry: bool) -> bool:
    if effect in GEOMETRY:
        return geometry
    return effect_of(effect).registered or effect_of(effect).elastic


def _step(B: Array, r: Array, size: Array, away: Array, least: Array) -> Array:
    """The step d that minimises |B d − r|² + Σ ((d + away) / size)², no less than `least`: a spring
    that would yield the wrong way is rigid."""
    A = np.vstack([B * size, np.eye(len(size))])
    b = np.concatenate([r, -away / size])
    found = lsq_linear(A, b, (least / size, np.inf), method="bvls")
    return np.where(found.active_mask < 0, least, found.x * size)  # at its bound to the last bit


class _Curves:
    """Curves of every joint against every joint's angle, linear between KNOTS places, and what it
    errs by with the sides that the joints came from: the coefficients of a joint correction."""

    def __init__(self, rows: Measurements, measured: Array) -> None:
        n = measured.shape[1]
        self.places = np.linspace(measured.min(axis=0), measured.max(axis=0), KNOTS)
        self.moving = [i for i in range(n) if np.ptp(measured[:, i]) > MOVED]
        unit = np.eye(KNOTS)
        hats = [
            np.column_stack([np.interp(rows.q[:, i], self.places[:, i], u) for u in unit])
            for i in self.moving
        ]
        self.hats = np.stack(hats, axis=1)  # rows, moving joints, KNOTS
        assert rows.approach is not None  # drawn
        self.side, self.n = rows.approach, n

    @property
    def count(self) -> int:
        return self.n * len(self.moving) * KNOTS + self.n

    def columns(self, B: Array) -> Array:
        """(components, count): what each coefficient moves, by B (components, joints)."""
        size = len(B) // len(self.side)
        hats = np.repeat(self.hats, size, axis=0)
        bent = np.einsum("rj,rik->rjik", B, hats).reshape(len(B), -1)
        return np.hstack([bent, B * np.repeat(self.side, size, axis=0)])

    def correction(self, start: JointCorrection, c: Array) -> JointCorrection:
        """`start` and the curves of coefficients c (count,)."""
        bent = c[: -self.n].reshape(self.n, len(self.moving), KNOTS)
        curves = [
            CorrectionCurve(j, f"joint{i + 1}", self.places[:, i], bent[j, k])
            for j in range(self.n)
            for k, i in enumerate(self.moving)
        ]
        sides = [
            CorrectionCurve(j, f"approach{j + 1}", np.array([-1.0, 1.0]), np.array([-s, s]))
            for j, s in enumerate(c[-self.n :])
        ]
        return JointCorrection((*start.curves, *curves, *sides)).merged()
