"""The plan: poses in order, what they promise, how far from the best; as CSV and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import linalg, special

from elastocal.above import Result
from elastocal.cell_tables import TEST_POSE
from elastocal.files import atomic_write
from elastocal.measurements import (
    DEFAULT_MARKER,
    Measurements,
    families,
    in_file_units,
    joint_columns,
)
from elastocal.messages import rounded
from elastocal.model.chain import joint_index
from elastocal.model.manipulator import Model
from elastocal.planning.criteria import ScenarioCriterion, inverse
from elastocal.planning.execution import Execution, Stop
from elastocal.planning.feasibility import CandidateCounts
from elastocal.planning.information import Estimable
from elastocal.tables import csv_text
from elastocal.units import Array, BoolArray, IntArray, to_si

TOLD = 3  # parameters named per pose
COMBINED = 0.01  # share of a typical deviation that counts as being part of a combination
ALONE, ROUNDING = 1e-9, 1e-6  # share of a direction that no other pose shows; of a variance


@dataclass(frozen=True)
class Predicted:
    """Standard deviation and half width of the 95 % interval of a parameter, in its unit, or of its
    sum with what the readings cannot tell from it, `combined_with`."""

    name: str
    unit: str
    std: float
    half_width: float
    combined_with: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reason:
    """What a plan loses without one pose: `loss` of the criterion, as a factor (inf: everything),
    and what it `serves`: by what factor the standard deviations grow of those that lose most."""

    loss: float
    serves: tuple[tuple[str, float], ...]


def predicted(found: Estimable, M: Array, n_numbers: int) -> tuple[Predicted, ...]:
    """Intervals of the kept parameters from M (p, p), scaled by their sizes: cov(X̂) = M⁻¹ (eq. 13
    of Klimchik et al. 2013), Student's t with `n_numbers` − p degrees of freedom."""
    model, r, sizes = found.model, found.reduction, found.sizes
    std = np.sqrt(np.diag(inverse(M))) * sizes[r.kept]
    quantile = float(special.stdtrit(max(n_numbers - len(r.kept), 1), 0.975))
    return tuple(
        Predicted(
            model.names[c], model.parameters[c].unit, float(std[k]), float(quantile * std[k]),
            tuple(
                model.names[d]
                for j, d in enumerate(r.dropped)
                if abs(r.mixing[k, j]) * sizes[d] > COMBINED * sizes[c]
            ),
        )
        for k, c in enumerate(r.kept)
    )  # fmt: skip


def reasons(names: Sequence[str], blocks: Array, M: Array, losses: Array) -> tuple[Reason, ...]:
    """Why each pose of a plan is in it: `blocks` (N, r, p) of its M (p, p) over the parameters
    `names`, and what the criterion loses without it, as a factor `losses` (N,)."""
    V, told = inverse(M), []
    for B, loss in zip(blocks, losses, strict=True):
        # V₋ = V + V Bᵀ (1 − B V Bᵀ)⁻¹ B V.  A direction that a pose carries alone leaves 1 − BVBᵀ
        # singular: a parameter is lost where that has a share of its variance.
        share, turn = linalg.eigh(B @ V @ B.T)
        part = (turn.T @ B @ V) ** 2 / np.diag(V)
        alone = 1 - share < ALONE
        growth = np.sqrt(1 + (part[~alone] / (1 - share[~alone, None])).sum(axis=0))
        lost = part[alone].sum(axis=0)
        growth[lost > ROUNDING] = np.inf
        first = np.lexsort((-lost, -growth))[:TOLD]
        serves = tuple((names[k], float(growth[k])) for k in first if growth[k] > 1.005)
        told.append(Reason(float(loss), serves))
    return tuple(told)


# The plan on disk: plan.csv, which `simulate` takes and people measure by, and plan.json.

SCHEMA = "elastocal/plan/1"
# Of degrees and mm: 9e-12 rad and 5e-13 m, and a level of -25.24° reads so.
DIGITS = 9


def _rows(
    execution: Execution, by_load: bool, by_visit: bool, seen: BoolArray | None
) -> tuple[list[list[tuple[int, Stop]]], IntArray]:
    """The stops of each row, with their places in the order, and its marker (rows,)."""
    visits: dict[tuple[int, ...], list[tuple[int, Stop]]] = {}
    for place, stop in enumerate(execution.stops, start=1):
        load = stop.load if by_load else -1
        key = (stop.again > 0, stop.pose, stop.again, stop.side, load, by_visit * stop.part)
        visits.setdefault(key, []).append((place, stop))
    rows = [visits[key] for key in sorted(visits)]
    if seen is None:
        return rows, np.zeros(len(rows), dtype=np.int64)
    of, marker = np.nonzero(np.array([seen[stop.pose, stop.load] for (_, stop), *_ in rows]))
    return [rows[k] for k in of], marker


def load_name(force: Array) -> str:
    if not np.any(force):
        return "unloaded"
    return " ".join(f"{value + 0.0:g}" for value in force) + " N"


def write_plan(
    path: str | Path, table: Measurements, more: Mapping[str, Sequence[str]], forces: bool = True
) -> None:
    """Write plan.csv, whole or not at all; angles in degrees, travel in mm; with the forces of the
    rows or not, and `more` columns."""
    found, kinds = table.columns(), table.joint_kinds
    columns: dict[str, Any] = {"configuration": found["configuration"]}
    if table.marker_names != (DEFAULT_MARKER,):
        columns["marker"] = found["marker"]
    if table.repeat.any():
        columns["repeat"] = table.repeat
    joints = np.round(in_file_units(table.q, kinds), DIGITS) + 0.0
    columns |= zip(joint_columns(kinds), joints.T, strict=True)
    if forces:
        columns |= {h: found[h] + 0.0 for h in ("force_x_N", "force_y_N", "force_z_N")}
    if table.approach is not None:
        columns |= {h: found[h] for h in families(kinds)["approach"].units}
    if table.time is not None:
        columns["time_s"] = np.round(table.time, 3)
    columns |= more
    rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
    atomic_write(path, csv_text(columns, rows))


@dataclass(frozen=True)
class Certificate:
    """How far the plan is from the best, as shares of the criterion; None without a bound.

    `efficiency_pool` is certified: no plan with the same shares from the `pool` candidates has a Φ
    below `bound_pool`.  `efficiency_continuum` is an estimate: the search tried `searched` poses
    and `ascents` local searches.  `starts`: where each start of it ended, in the plan's unit.
    """

    pool: int
    bound_pool: float | None = None
    efficiency_pool: float | None = None
    bound_continuum: float | None = None
    efficiency_continuum: float | None = None
    searched: int = 0
    ascents: int = 0
    starts: tuple[float, ...] = ()

    def of(self, value: float) -> Certificate:
        """That of a plan of Φ = `value` under the same bounds."""
        bounds = self.bound_pool, self.bound_continuum
        pool, continuum = (None if bound is None else min(bound / value, 1.0) for bound in bounds)
        return replace(self, efficiency_pool=pool, efficiency_continuum=continuum)

    @property
    def better_pool(self) -> float | None:
        """The share of the error (√Φ, as people know it) by which a plan of the pool may be
        better, up to the next per mille; none below half of one."""
        if self.efficiency_pool is None:
            return None
        share = 1e3 * (1 - np.sqrt(self.efficiency_pool))
        return float(np.ceil(share)) / 1e3 if share >= 0.5 else 0.0

    @property
    def vain(self) -> bool:
        """Whether the bound says nothing: so few poses cannot be spread as its weights are."""
        return self.efficiency_pool is not None and self.efficiency_pool < 0.1


@dataclass(frozen=True)
class Chance:
    """The same number of random feasible poses: criteria of `n` such plans in the plan's unit, of
    which `determined` determine every parameter.  `efficiency` is the plan's Φ over the median's:
    without prior knowledge random plans need 1/efficiency times as many readings."""

    n: int
    determined: int
    median: float | None
    best: float | None
    worst: float | None
    efficiency: float | None

    @classmethod
    def of(cls, drawn: Array, value: float, criterion: ScenarioCriterion) -> Chance:
        """Of random plans' information (n, p, p), and the plan's Φ, `value`."""
        values = np.sort(criterion.of_information(drawn))
        phi = (float(np.median(values)), float(values[0]), float(values[-1]))
        median, best, worst = (criterion.figure(v) if np.isfinite(v) else None for v in phi)
        share = value / phi[0] if criterion.certifiable and np.isfinite(phi[0]) else None
        return cls(len(values), int(np.isfinite(values).sum()), median, best, worst, share)


@dataclass(frozen=True)
class Everywhere:
    """Rms position error in m after compensation, at the test poses and over all joint ranges, of
    the plan and of the median random plan (None where that leaves parameters open), and of the
    plan with the drift that the cell states.  `share` of the criterion's weight lies on the joint
    ranges, so that the error at the test poses is at most about `cap` above the least; 0 where no
    such cap was asked for."""

    test_poses: float
    elsewhere: float
    random_test_poses: float | None
    random_elsewhere: float | None
    drifting_test_poses: float
    drifting_elsewhere: float
    share: float = 0.0
    cap: float = 0.0


def remaining_rms(R: Array, M: Array) -> float:
    """√tr(R M⁻¹ Rᵀ); inf where M (p, p) is singular."""
    try:
        V = linalg.cho_solve(linalg.cho_factor(M), R.T)
    except linalg.LinAlgError:
        return np.inf
    return float(np.sqrt(max(np.sum(R.T * V), 0.0)))


DRAWS = 2000  # of what the arm may be


@dataclass(frozen=True)
class Gain:
    """What a plan adds to measurements done: rms position error in m at the test poses, expected
    by the parameters alone, `model_before` and `model_after`, and with what the model lacks; inf
    where they leave parameters open.  `sure`: with 95 % the present error is smaller, with what is
    held at typical deviations."""

    before: float
    after: float
    model_before: float
    model_after: float
    sure: float

    @classmethod
    def of(cls, R: Array, before: Array, after: Array, seed: int) -> Gain:
        """Of R (r, p + d) at the test poses, d for what is held at its typical deviation, and the
        information (p, p) before and after the plan."""
        R, held = np.split(R, [len(before)], axis=1)
        known, found = remaining_rms(R, before), remaining_rms(R, after)
        sure = np.inf
        if np.isfinite(known):
            z = np.random.default_rng(seed).standard_normal((DRAWS, len(R)))
            every = R @ np.linalg.solve(before, R.T) + held @ held.T
            variance = np.maximum(np.linalg.eigvalsh(every), 0.0)
            sure = float(np.sqrt(np.quantile(z**2 @ variance, 0.95)))
        return cls(known, found, known, found, sure)

    def lacking(self, error: float, sure: float) -> Gain:
        """With what the model lacks, which moves the tool by `error` rms; `sure` is kept."""
        both = np.hypot((self.before, self.after), error)
        return replace(self, before=float(both[0]), after=float(both[1]), sure=sure)


@dataclass(frozen=True)
class PlanSize:
    """The criterion of the best plan found of `poses` poses, and its bound, in the plan's unit."""

    poses: int
    value: float
    bound: float | None


@dataclass(frozen=True)
class Scheduled:
    """`effects` that show by time and order alone, found with all else: rms position error in m at
    the `test_poses`, and that `without` them; None where no plan can make it certain."""

    effects: tuple[str, ...]
    test_poses: float | None
    without: float | None


LOAD_POINT, TRACKER = "load point", "tracker"  # beside the markers' names


@dataclass(frozen=True)
class Chosen:
    """`places` name → before and after (2, 3) m, `loads` (k, 3) N where they were chosen; the
    relaxed optimum `before` and `after` in `unit`, and the `share` of feasible poses, each on
    `candidates` that the rules allow there; None where the cell as it stands has no plan."""

    places: dict[str, Array]
    loads: Array | None
    before: float | None
    after: float
    unit: str
    candidates: int
    share: tuple[float | None, float]

    @property
    def keys(self) -> dict[str, dict[str, Any]]:
        at = {name: place[1].tolist() for name, place in self.places.items()}
        found: dict[str, dict[str, Any]] = {"tool": {}, "tracker": {}, "design": {}}
        if LOAD_POINT in at:
            found["tool"]["load_point_m"] = at.pop(LOAD_POINT)
        if TRACKER in at:
            found["tracker"]["position_m"] = at.pop(TRACKER)
        if at:
            found["tool"]["markers_m"] = at
        if self.loads is not None:
            found["design"]["loads_N"] = self.loads.tolist()
        return {table: keys for table, keys in found.items() if keys}


@dataclass(frozen=True)
class LoadStates:
    """In which load states poses are read: each in `"all"`, or each in those `"chosen"` for it.

    `crossed` and `chosen`: the relaxed optimum of both in the plan's unit, in as much time; None
    where there is nothing to choose, and `why`.
    """

    used: Literal["all", "chosen"]
    why: str
    crossed: float | None = None
    chosen: float | None = None


@dataclass(frozen=True)
class TimedSize:
    """`poses` with `repeats` readings of each marker in each load state take about `minutes` and
    reach `value`, the criterion in the plan's unit, on few candidates."""

    poses: int
    repeats: int
    minutes: float
    value: float


@dataclass(frozen=True, repr=False, eq=False)
class Plan(Result):
    """A measurement plan: poses in their order, what they promise, how far from the best they are.

    Attributes:
        model: The `Model` that it is for.
        criterion: What was made small; `value` is it as the search has it (Φ), `reported` as people
            know it, in `unit`.
        q: Commanded joints (N, joints), in rad or m.
        forces: Load states (L, 3), in N, in each of which all poses are read.
        group: (N,), the level of each pose, an index into `levels` of the joint `level_joint`.
        execution: The order of execution, with the points in between.
        candidates: How many poses were tried, and which rule removed how many.
        certificate: How far the plan is from the best: certified on the pool of candidates,
            estimated on the continuum.
        predicted: How far each parameter will be known.
        reasons: What each pose is for.
        targets: What the test poses were, in words.
        seed: Of all random draws.
        polished: How many poses were moved from their candidate.
        curve: The criterion against the number of poses, where it was asked for.
        bound_reported: The certificate's bound, in `unit`.
        warnings: What to know before one measures, in sentences.
        made_for: Beside measurements done, the arm that the plan is made for, in words.
        chance: What as many random poses would reach.
        everywhere: The error at the test poses and over all joint ranges, in m.
        seen: Which markers are read of each pose in each load state (N, L, markers); None for all.
        readings: How often each of them is read of each pose in each load state (N, L).
        states: Whether poses are read in all load states or in chosen ones, where it was asked.
        names: Of the configurations.
        gain: What the plan adds to measurements done, where it does.
        chosen: What was chosen besides the poses, where [design.choose] asks for it.
        scheduled: What effects of time and approach make of it, where the cell has some.
        timed: Numbers of poses and readings that a time allows, where one was given.

    Examples:
        >>> plan = ec.design(
        ...     "cell.toml", poses=4, criterion="D", candidates=60, effort="quick",
        ...     loads=[[0, 0, -2600]], levels={"joint2": np.radians([-25.24, -99.85])},
        ... )
        >>> len(plan), plan.q.shape, plan.unit
        (4, (4, 6), 'log det')
        >>> data = ec.simulate("cell.toml", plan, load=[0, 0, -2600])
        >>> plan.save("plan4.csv")
    """

    model: Model
    criterion: str
    value: float
    reported: float
    unit: str
    q: Array
    forces: Array
    group: IntArray
    levels: tuple[float, ...]
    level_joint: str | None
    execution: Execution
    candidates: CandidateCounts
    certificate: Certificate
    predicted: tuple[Predicted, ...]
    reasons: tuple[Reason, ...]
    targets: str
    seed: int
    polished: int = 0
    curve: tuple[PlanSize, ...] = ()
    bound_reported: float | None = None
    warnings: tuple[str, ...] = field(default=())
    made_for: str = ""
    chance: Chance | None = None
    everywhere: Everywhere | None = None
    seen: BoolArray | None = None
    readings: IntArray = field(kw_only=True)
    states: LoadStates | None = None
    names: tuple[str, ...] = ()
    gain: Gain | None = None
    chosen: Chosen | None = None
    timed: tuple[TimedSize, ...] = ()
    scheduled: Scheduled | None = None

    def __repr__(self) -> str:
        away = self.certificate.better_pool
        told = "" if away is None else f", none of its pool is over {100 * away:.1f} % better"
        return (
            f"<Plan {self.model.chain.name}: {len(self)} poses by {self.criterion}, "
            f"{rounded(self.reported, 4)} {self.unit}{told}>"
        )

    def __len__(self) -> int:
        return len(self.q)

    def table(self) -> Measurements:
        """The poses as a table for `simulate`, as the plan's file has them."""
        return self.rows[0]

    @property
    def of_test_poses(self) -> bool:
        """What was made small is the error at the test poses alone."""
        return self.criterion == TEST_POSE

    @property
    def rows(self) -> tuple[Measurements, dict[str, list[str]]]:
        """The table that is read of the plan, sorted by pose, side of approach and load state, and
        its columns beside: level, order and notes.

        Where `stated_forces` are, one row per reading, under its force, where time counts one per
        visit; else one per pose and side, to be measured in every load state.  `order` is the first
        of its stops, note_order_2 the second, …; note_load, note_load_2, … what of the load states
        hangs there.  A pose that is approached from both sides is two configurations, 7+ (joints
        moving up to it) and 7-.  Where only some markers are seen there is a row for each, where
        poses are not read alike note_readings says how often each is.
        """
        forces, kinds = self.stated_forces, self.model.chain.kinds
        timed = self.execution.stops[0].time is not None
        # Of deflections each loaded reading has one partner, the mean of those without load.
        apart = timed and self.model.observe != "deflection"
        rows, marker = _rows(self.execution, forces is not None, apart, self.seen)
        own = tuple(self.model.cell.tool.markers)
        first, n = [row[0][1] for row in rows], len(rows)
        two = self.execution.motion.both_directions or any(stop.side for stop in first)
        names = [stop.name(self.names) + ("+", "-")[stop.side] * two for stop in first]
        labels = tuple(dict.fromkeys(names))
        approach = [stop.approach for stop in first if stop.approach is not None]
        times = [[stop.time for _, stop in row if stop.time is not None] for row in rows]
        time = np.array([sum(each) / len(each) for each in times if each])
        # As the digits of the file say it.
        shown = np.round(in_file_units(np.array([stop.q for stop in first]), kinds), DIGITS).T
        units = ["deg" if kind == "revolute" else "mm" for kind in kinds]
        q = [to_si(values, unit) for values, unit in zip(shown, units, strict=True)]
        force = np.zeros((n, 3)) if forces is None else forces[[stop.load for stop in first]]
        table = Measurements.of_poses(
            "plan", np.column_stack(q), force, row=np.arange(n) + 2,
            configuration=np.array([labels.index(name) for name in names]),
            configuration_labels=labels, marker=marker,
            repeat=np.array([stop.part * apart for stop in first]),
            marker_names=own if self.seen is not None else (DEFAULT_MARKER,),
            approach=np.array(approach, dtype=float) if approach else None,
            time=np.round(time, 3) if len(time) else None, joint_kinds=tuple(kinds),
        )  # fmt: skip

        def nth(told: Callable[[int, Stop], str], i: int) -> list[str]:
            return [told(*row[i]) if i < len(row) else "" for row in rows]

        most, hung = range(max(map(len, rows))), [load_name(load) for load in self.forces]
        beside = {"level": [str(self.group[stop.pose] + 1) for stop in first]}
        for i in most:
            beside[f"note_order_{i + 1}" if i else "order"] = nth(lambda k, _: str(k), i)
        if not self.crossed:
            beside["note_load"] = nth(lambda _, stop: hung[stop.load], 0)
            beside["note_readings"] = nth(lambda _, s: str(self.readings[s.pose, s.load]), 0)
        elif forces is None and self.forces.any():
            for i in most:
                name = "note_load" + (f"_{i + 1}" if i else "")
                beside[name] = nth(lambda _, stop: hung[stop.load], i)
        return table, beside

    @property
    def crossed(self) -> bool:
        """Is every pose read in every load state?"""
        return bool((self.readings > 0).all())

    @property
    def read_in(self) -> IntArray:
        """How many poses are read in each load state (L,)."""
        return np.count_nonzero(self.readings, axis=0)

    def loads(self, k: int) -> str:
        """The load states in which pose k is read."""
        return ", ".join(load_name(force) for force in self.forces[self.readings[k] > 0])

    def markers(self, k: int) -> str:
        """The markers to be read of pose k, those in brackets under some of the loads only."""
        names = self.model.cell.tool.markers
        if self.seen is None:
            return " ".join(names)
        every, some = self.seen[k].all(axis=0), self.seen[k].any(axis=0)
        told = zip(names, every, some, strict=True)
        return " ".join(name if all_ else f"({name})" for name, all_, any_ in told if any_)

    @property
    def group_names(self) -> tuple[str, ...]:
        """The levels as people read them: "joint2 at -25.24°"."""
        if (joint := self.level_joint) is None:
            return ("poses",)
        kind = self.model.chain.kinds[joint_index(joint)]
        unit = "°" if kind == "revolute" else " mm"
        levels = in_file_units(np.array(self.levels)[:, None], [kind])
        return tuple(f"{joint} at {v:.6g}{unit}" for v in levels[:, 0])

    @property
    def stated_forces(self) -> Array | None:
        """The load states (L, 3) in N where the plan's rows state them; else None.

        They do where there are several loads, poses are revisited, or a load hides a marker.
        """
        loaded = np.any(self.forces != 0, axis=1)
        usual = not loaded[0] and loaded[1:].all() and len(loaded) <= 2
        again = any(stop.again for stop in self.execution.stops)
        alike = self.seen is None or bool((self.seen == self.seen[:, :1]).all())
        again |= self.scheduled is not None or self.execution.stops[0].time is not None
        every = usual and alike and self.crossed and not again
        return None if every else self.forces

    def to_json(self) -> dict[str, Any]:
        """The plan as numbers and texts; the file adds its schema."""
        bounds = asdict(self.certificate)
        del bounds["bound_continuum"]
        told = {"pool_is": "certified on the pool", "continuum_is": "estimated on the continuum"}
        return {
            "criterion": self.criterion,
            "value": self.reported,
            "unit": self.unit,
            "n_poses": len(self.q),
            "candidates": asdict(self.candidates),
            "certificate": bounds | told | {"bound_pool": self.bound_reported},
            "random_plans": self.chance and asdict(self.chance),
            "everywhere": self.everywhere and asdict(self.everywhere),
            "gain": self.gain and asdict(self.gain),
            "chosen": (c := self.chosen) and {
                "cell": c.keys,
                "relaxed": {"before": c.before, "after": c.after, "candidates": c.candidates},
                "feasible": {"before": c.share[0], "after": c.share[1]},
            },
            "load_states": (s := self.states) and {
                "used": s.used,
                "why": s.why,
                "unit": self.unit,
                "relaxed": {"all": s.crossed, "chosen": s.chosen},
                "stops": [
                    {"load_N": force, "poses": n}
                    for force, n in zip(self.forces.tolist(), self.read_in.tolist(), strict=True)
                ],
            },
            "drift": (d := self.execution.drift) and asdict(d),
            "predicted": [
                {("ci95_half_width" if k == "half_width" else k): v for k, v in asdict(p).items()}
                for p in self.predicted
            ],
            "poses": [
                {
                    "configuration": k + 1,
                    "markers": self.markers(k),
                    "name": self.names[k],
                    "loads_N": self.forces[self.readings[k] > 0].tolist(),
                    "readings": int(self.readings[k].max()),
                    "value_without": None if not np.isfinite(r.loss) else r.loss,
                    "serves": [
                        {"name": name, "std_without": None if not np.isfinite(f) else f}
                        for name, f in r.serves
                    ],
                }
                for k, r in enumerate(self.reasons)
            ],
            "scheduled": self.scheduled and asdict(self.scheduled),
            "timed": [asdict(size) for size in self.timed],
            "minutes": self.execution.total / 60,
            "via": [{"stop": stop, "q_si": q.tolist()} for stop, q in self.execution.between],
            "curve": [{"n_poses": s.poses, "value": s.value, "bound": s.bound} for s in self.curve],
            "warnings": list(self.warnings),
            **({"made_for": self.made_for} if self.made_for else {}),
            "seed": self.seed,
        }  # fmt: skip
