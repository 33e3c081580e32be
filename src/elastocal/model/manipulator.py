"""The model: nominal chain plus effects, and its regressor B for a whole table at once."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.above import ByValue, DataFrame, checked_arguments
from elastocal.cell import Cell
from elastocal.cell_tables import EffectChoice, ModelSpec
from elastocal.files import Carried
from elastocal.measurements import DEFAULT_MARKER, Measurements, read_measurements
from elastocal.measurements import table as table_of
from elastocal.messages import InputError, listed, option, require
from elastocal.model.chain import Chain, numbered, plausible
from elastocal.model.effects.base import (
    Effect,
    JointMotion,
    Parameter,
    given_force,
    index,
    row_inputs,
)
from elastocal.model.effects.catalogue import BUILT_IN, CATALOGUE, SymbolicArm, cell_of, effect_of
from elastocal.model.effects.geometry import DistanceSensor
from elastocal.model.effects.smooth import SmoothFunction
from elastocal.model.evaluate import CHUNK, chosen_backend, row_blocks, thread_count
from elastocal.model.observations import Observations, observe
from elastocal.units import Array, IntArray


@dataclass(frozen=True)
class Regression:
    """B (rows, parameters) = ∂prediction/∂parameters, prediction (rows,) and what was observed.

    Rows are observations × components in the table's order; units are m (and rad) per unit of
    the parameter.
    """

    B: Array
    prediction: Array
    observations: Observations

    @property
    def residual(self) -> Array:
        """Observed minus predicted (rows,)."""
        return self.observations.value - self.prediction


KEPT = 2**22  # numbers of B that a model keeps at most


class Model(ByValue):
    """p_i = h(q_i, f_i, …; X) for an arm with effects; CasADi differentiates it exactly.

    Attributes:
        cell: The `Cell` that it models.
        chain: The nominal kinematic chain of the robot.
        parameters: `Parameter`s of all active effects, in the order of every vector x and of the
            columns of B.
        names: Their names.
        nominal: Their nominal values x (parameters,), in SI units.
        observe: What a reading is: "position", "deflection", "pose" or "distance".

    Args:
        cell: A cell file (TOML), or a `Cell` built in Python.
        markers: The markers' names where the cell lists none; default one, "M1".  Every verb
            takes them from the table where neither says them.
        backend: What evaluates it: "auto" or "numpy"; None follows the environment
            variable ELASTOCAL_BACKEND.
        plugins: Run the Python files and modules that the cell names under [plugins]; None does
            without them where no effect of the model is theirs.

    Raises:
        InputError: The cell, or a file that it names, is wrong; the message says where.

    Examples:
        >>> model = ec.Model("cell.toml")
        >>> model
        <Model ...: kuka_kr270_2, 6 joints, 10 parameters of joint_compliance; observes deflection>
        >>> model.names[:2]
        ('joint1.compliance', 'joint2.compliance_level1')
        >>> plan = model.read_plan("plan.csv")
        >>> model.pose(plan.q[0])[:3, 3].round(3)
        array([...])
        >>> model.B(model.read("data.csv")).shape
        (810, 10)
    """

    @checked_arguments
    def __init__(
        self, cell: Cell | str | Path, markers: Sequence[str] = (), backend: str | None = None,
        plugins: bool | None = False,
    ) -> None:  # fmt: skip
        cell = cell_of(cell, plugins)
        self._markers_stated = bool(cell.tool.markers)
        if not self._markers_stated:
            cell = _with_markers(cell, tuple(markers) or (DEFAULT_MARKER,))
        # Distances are from somewhere: a place that is stated, or that a fitted effect finds.
        base = cell.model.nominal.base_position
        effects = (effect_of(choice.name) for choice in cell.model.effects)
        placed = cell.tracker.anchor is not None or (base is not None and bool(base.any()))
        found = placed or any(each.registered and each.at != "markers" for each in effects)
        require(
            cell.model.observe != "distance" or found,
            f'{cell.source}: key model.observe = "distance" needs the place that distances are '
            f'from; add "{DistanceSensor.name}" to [model] effects, which finds it, or state '
            "[tracker] anchor_m = [x, y, z] in the data's frame",
        )
        chain = load_chain(cell)
        chosen = None if backend is None else chosen_backend(backend)
        self._assemble(chain, numbered(cell, chain), (), chosen)

    @classmethod
    def assembled(
        cls, chain: Chain, cell: Cell, extra: Sequence[tuple[Effect, str]] = (),
        backend: str | None = None,
    ) -> Model:  # fmt: skip
        """The model of a chain that is there already; `cell` says all else.

        `extra` effects with their places act besides those that the cell chooses.
        """
        model = cls.__new__(cls)
        model._markers_stated = True
        model._assemble(chain, cell, extra, backend)
        return model

    def _assemble(
        self, chain: Chain, cell: Cell, extra: Sequence[tuple[Effect, str]], backend: str | None
    ) -> None:
        self.chain, self.cell, self._extra = chain, cell, tuple(extra)
        self.observe = cell.model.observe
        self.symbolic = SymbolicArm(chain, cell, extra, backend)  # its expressions
        self.parameters: tuple[Parameter, ...] = self.symbolic.parameters
        self._kept: tuple[Any, Regression] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by what it is made of; another process derives the functions again."""
        plugins = Carried(Path(self.cell.source), self.cell.plugins)  # run first
        made_of = plugins, self.chain, self.cell, self._extra, self.symbolic.backend
        return _arrived, made_of, {"_markers_stated": self._markers_stated}

    def _compared(self) -> Mapping[str, Any]:
        cell = {k: v for k, v in vars(self.cell).items() if k not in ("name", "path", "robot")}
        extra = [(effect.name, place) for effect, place in self._extra]
        return cell | {"chain": self.chain, "extra": extra, "backend": self.symbolic.backend}

    def __hash__(self) -> int:
        return hash((self.chain.name, self.names))

    def __repr__(self) -> str:
        effects = listed(dict.fromkeys(p.effect for p in self.parameters), 6) or "no effect"
        return (
            f"<Model {self.cell.name}: {self.chain.name}, {self.chain.n_joints} joints, "
            f"{len(self.parameters)} parameters of {effects}; observes {self.observe}>"
        )

    @checked_arguments
    def read(self, path: str | Path | DataFrame) -> Measurements:
        """The measurements of a CSV or Parquet file or a pandas data frame, in SI units.

        Args:
            path: The table; its columns are those that the model observes, units stand in the
                header.

        Raises:
            InputError: The table is wrong; the message names file, line, column and the text.

        Examples:
            >>> data = ec.Model("cell.toml").read("data.csv")
            >>> len(data), data.q.shape, data.marker_names
            (540, (540, 6), ('M1', 'M2', 'M3'))
        """
        return self._read(path, self.observe)

    @checked_arguments
    def read_plan(self, path: str | Path | DataFrame) -> Measurements:
        """The poses of a plan, a row each; forces (N) where it states them.

        Args:
            path: The plan (CSV, or a data frame): configuration, q1_deg …

        Raises:
            InputError: As `read` does.

        Examples:
            >>> len(ec.Model("cell.toml").read_plan("plan.csv"))
            15
        """
        return self._read(path, "plan")

    def _read(self, path: str | Path | DataFrame, observe: str) -> Measurements:
        markers = tuple(self.cell.tool.markers) if self._markers_stated else ()
        return read_measurements(
            path, joint_kinds=self.chain.kinds, marker_names=markers, observe=observe
        )

    @checked_arguments
    def table(
        self, q: ArrayLike, force: ArrayLike | None = None, position: ArrayLike | None = None
    ) -> Measurements:
        """A table of readings of one marker that no file states; as `ec.table`.

        Args:
            q: Commanded joints (n, joints) or (joints,), in rad or m.
            force: Forces (n, 3) or (3,) in N at the load point, in the data's frame; default none.
            position: Measured positions (n, 3) in m in the data's frame, where there are any.

        Raises:
            InputError: A shape does not fit.

        Examples:
            >>> model = ec.Model("cell.toml")
            >>> table = model.table([0.1, -1.0, 1.0, 0.0, 0.5, 0.0], force=[0, 0, -2600])
            >>> model.deflection(table).shape
            (1, 6)
        """
        found, n = np.shape(np.atleast_2d(q)), self.chain.n_joints
        told = f"q takes {n} joints per row; found an array of shape {np.shape(q)}"
        require(0 < len(found) <= 2 and found[0] > 0 and found[-1] == n, told)
        marker = next(iter(self.cell.tool.markers), DEFAULT_MARKER)
        return table_of(q, position, force, marker, self.chain.kinds)

    @checked_arguments
    def pose(
        self, q: ArrayLike, x: ArrayLike | None = None, load: ArrayLike | None = None
    ) -> NDArray:
        """The flange's pose in the data's frame, T_tracker_flange, deflections included.

        Args:
            q: Commanded joints (joints,) or (n, joints), in rad or m.
            x: Parameter values (parameters,) in SI units; default the nominal ones.
            load: Force (3,) or (n, 3) in N at the load point, in the data's frame; default none.

        Returns:
            (4, 4), or (n, 4, 4) where q has rows; NaN where there is no static equilibrium.

        Raises:
            InputError: A shape does not fit, or an active effect needs more than joints and
                load (a time, a temperature): then `flange_poses` takes a table.

        Examples:
            >>> ec.Model("cell.toml").pose([0.0, -1.0, 1.0, 0.0, 0.5, 0.0]).shape
            (4, 4)
        """
        given_force(load, len(np.atleast_2d(q)))
        poses = self.flange_poses(self.table(q, load).from_neither_side(), self._at(x))
        return poses[0] if np.ndim(q) == 1 else poses

    def with_markers_of(self, *tables: Measurements) -> Model:
        """This model with the markers of the tables, where the cell lists none."""
        names = tuple(dict.fromkeys(name for t in tables for name in t.marker_names))
        if self._markers_stated or not names or names == tuple(self.cell.tool.markers):
            return self
        cell = _with_markers(self.cell, names)
        model = Model.assembled(self.chain, cell, backend=self.symbolic.backend)
        model._markers_stated = False
        return model

    def with_effects(self, effects: tuple[EffectChoice, ...]) -> Model:
        """The same arm with another choice of effects."""
        return self.specified(replace(self.cell.model, effects=effects))

    def specified(self, spec: ModelSpec, extra: Sequence[tuple[Effect, str]] = ()) -> Model:
        """The same arm with all of another [model]."""
        cell = replace(self.cell, model=spec)
        return Model.assembled(self.chain, cell, extra, self.symbolic.backend)

    def stating(self, **keys: Any) -> Model:
        """The same, its expressions too, where [model] states other `keys` that none of its effects
        reads; models derived from it may."""
        other, cell = Model.__new__(Model), self.cell
        vars(other).update(vars(self), cell=replace(cell, model=replace(cell.model, **keys)))
        vars(other).pop("_derived", None)
        return other

    @cached_property
    def rigid(self) -> Model:
        """The nominal arm with no effect and its base at the data's origin, for registration."""
        spec = self.cell.model
        nominal = replace(spec.nominal, base_position=None, base_rotation=None)
        spec = replace(spec, effects=(), observe="position", nominal=nominal, link_gravity=False)
        return self.specified(spec)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def shrunk(self) -> NDArray[np.bool_]:
        """Which parameters (parameters,) are those of smooth functions, with a prior of their
        own."""
        return np.array([p.shrunk for p in self.parameters], dtype=bool)

    def meant_by(self, name: str) -> list[int]:
        """Indices of the parameters that a parameter's, place's or effect's name stands for."""
        return [i for i, p in enumerate(self.parameters) if name in (p.name, p.where, p.effect)]

    @property
    def all_names(self) -> list[str]:
        """Every name that `meant_by` understands."""
        return sorted({v for p in self.parameters for v in (p.name, p.where, p.effect)})

    def backend_report(self) -> str:
        """What evaluates this model, for reports: engines and threads."""
        few = "casadi for few rows, else " * (chosen_backend(self.symbolic.backend) == "auto")
        threads = thread_count()
        return f"{few}numpy ({threads} thread{'s' * (threads > 1)})"

    @property
    def nominal(self) -> Array:
        return np.array([p.nominal for p in self.parameters])

    def sizes(self, B: Array) -> Array:
        """Typical deviation (parameters,) of each parameter, in its unit.

        Where none is known beforehand, one size for all parameters of that effect: ten times the
        deviation that moves the readings behind `B` by 1 mm at the place they show most (a
        wrist is about ten times as soft as a shoulder).
        """
        largest = np.abs(B).max(axis=0, initial=0.0)
        moved = np.divide(1e-3, largest, out=np.full(len(largest), np.inf), where=largest > 0)
        common: dict[tuple[str, str], float] = {}
        for p, m in zip(self.parameters, moved, strict=True):
            common[p.effect, p.unit] = min(common.get((p.effect, p.unit), np.inf), 10 * m)
        common = {key: size if np.isfinite(size) else 1.0 for key, size in common.items()}
        return np.array(
            [common[p.effect, p.unit] if p.typical is None else p.typical for p in self.parameters]
        )

    @cached_property
    def moving(self) -> Model:
        """The nominal arm with what registration places, and a small motion of each joint: the
        last parameters, whose B is ∂(reading)/∂q.  A deflection counts as a position."""
        spec = self.cell.model
        placed = tuple(c for c in spec.effects if effect_of(c.name).registered)
        observe = "position" if spec.observe == "deflection" else spec.observe
        spec = replace(spec, effects=placed, observe=observe, link_gravity=False)
        motion = JointMotion()
        return self.specified(spec, [(motion, w) for w in motion.places(self.chain, self.cell)])

    @checked_arguments
    def deflection(self, table: Measurements, x: Array | None = None) -> NDArray:
        """Elastic deflections θ at static equilibrium.

        Args:
            table: Readings, or a plan: what a table says of joints and loads.
            x: Parameter values (parameters,) in SI units; default the nominal ones.

        Returns:
            (n_rows, springs) in rad or m, one column per spring of the active effects; NaN where
            no equilibrium is found.

        Examples:
            >>> model = ec.Model("cell.toml")
            >>> loaded = model.table([0.1, -1.0, 1.0, 0.0, 0.5, 0.0], force=[0, 0, -2600])
            >>> bool(abs(model.deflection(loaded)).max() < 0.01)
            True
        """
        return self.symbolic.equilibrium(row_inputs(self.symbolic.arm, table), self._at(x))[0]

    def _at(self, x: ArrayLike | None, several: bool = False) -> NDArray:
        """Parameter values (parameters,), the nominal ones by default; or `several` (k, …)."""
        if x is None:
            return self.nominal
        values, n = np.asarray(x), len(self.parameters)
        fits = values.shape[-1:] == (n,) and 0 < values.ndim <= 1 + several and values.size > 0
        told = f"takes {n} numbers, one for each parameter; found an array of shape {values.shape}"
        require(fits or not n, f"{option('x')} {told}")
        return values

    @checked_arguments
    def predict(
        self, table: Measurements, x: Array | None = None, observations: Observations | None = None
    ) -> NDArray:
        """Predicted observations.

        Args:
            table: Readings, or rows of `simulate`: what was commanded and how it was loaded.
            x: Parameter values (parameters,) in SI units, or several (k, parameters); default the
                nominal ones.
            observations: What `observe` made of the table, which spares pairing it anew.

        Returns:
            (rows,), observations × components in m (rad), in the table's order, or (k, rows); NaN
            where there is no static equilibrium.

        Examples:
            >>> model = ec.Model("cell.toml")
            >>> model.predict(model.read("data.csv")).shape
            (810,)
        """
        x = self._at(x, several=True)
        inputs = row_inputs(self.symbolic.arm, table)
        observed = observations or observe(table, self.observe)
        if x.ndim == 1:
            return observed.apply(self._readings(inputs, x)).ravel()
        n, found = len(table), []
        # Together, as many as make up a block: a call for each takes several times as long.
        for some in (x[block] for block in row_blocks(len(x), CHUNK // max(n, 1))):
            rows = [np.tile(a, (len(some), 1)) for a in inputs]
            found.append(self._readings(rows, np.repeat(some, n, axis=0)).reshape(len(some), n, -1))
        return observed.apply(np.concatenate(found).transpose(1, 2, 0)).reshape(-1, len(x)).T

    def _readings(self, inputs: list[NDArray], x: NDArray) -> NDArray:
        """Readings (rows, size) at values x (parameters,), or (rows, parameters) by row."""
        theta = self.symbolic.equilibrium(inputs, x)[0]
        return self.symbolic.readings(*inputs, x, theta)[0][..., 0]

    @checked_arguments
    def B(self, table: Measurements, x: Array | None = None) -> NDArray:
        """The regressor B = ∂prediction/∂X (eq. 4 of Klimchik et al. 2013) of a whole table.

        Args:
            table: Readings.
            x: Parameter values (parameters,) at which to differentiate; default the nominal ones.

        Returns:
            (rows, parameters), in m (rad) per unit of each parameter.

        Raises:
            InputError: The table lacks a column that the model needs.
            ElastocalError: A pose has no static equilibrium under its load.

        Examples:
            >>> model = ec.Model("cell.toml")
            >>> model.B(model.read("data.csv")).shape
            (810, 10)
        """
        return self.regressor(table, x).B

    def regressor(
        self, table: Measurements, x: Array | None = None, columns: NDArray | None = None,
        observations: Observations | None = None,
    ) -> Regression:  # fmt: skip
        """B_i = ∂prediction/∂X stacked over the whole table (eq. 4), and the prediction.

        `columns` selects parameters by index (default all).  Raises InputError where the table
        lacks a column the model needs, ElastocalError where a pose has no static equilibrium.
        """
        x = self._at(x)
        chosen = tuple(range(len(x))) if columns is None else tuple(int(c) for c in columns)
        observed = observations or observe(table, self.observe)
        h, B = self.symbolic.regressor(row_inputs(self.symbolic.arm, table), x, columns=chosen)
        check_equilibrium(self, table, h)
        if not np.isfinite(B.sum()):
            row, column = np.argwhere(~np.isfinite(B).all(axis=1))[0]
            no_number(table, row, self.names[chosen[column]])
        prediction = observed.apply(h).ravel()
        return Regression(observed.apply(B).reshape(len(prediction), -1), prediction, observed)

    def kept_regressor(self, observed: Observations, x: Array, columns: NDArray) -> Regression:
        """`regressor` of these readings, and what it found until others are asked for: where a fit
        ends its weights begin, its held-out residuals and its faulty readings."""
        asked, kept = (x.tobytes(), columns.tobytes()), self._kept
        if kept is not None and kept[0] == asked and kept[1].observations is observed:
            return kept[1]
        found = self.regressor(observed.table, x, columns, observed)
        found.B.flags.writeable = found.prediction.flags.writeable = False
        if found.B.size <= KEPT:
            self._kept = asked, found
        return found

    def flange_poses(self, table: Measurements, x: Array | None = None) -> NDArray:
        """T_tracker_flange (n_rows, 4, 4) at parameter values x, deflections included."""
        return self._frames(table, x)[0]

    def target_poses(self, table: Measurements, x: Array | None = None) -> tuple[NDArray, NDArray]:
        """Rotation (n_rows, 3, 3) and position (n_rows, 3) of each row's marker as the tracker
        would report them, whatever the model observes.  Rows without an equilibrium are NaN."""
        _, position, rotation = self._frames(table, x)
        return rotation, position[..., 0]

    def _frames(self, table: Measurements, x: Array | None) -> list[NDArray]:
        x = self._at(x)
        inputs = row_inputs(self.symbolic.arm, table)
        return self.symbolic.frames(*inputs, x, self.symbolic.equilibrium(inputs, x)[0])


def measurements_of(model: Model, given: Measurements | str | Path | DataFrame) -> Measurements:
    return given if isinstance(given, Measurements) else model.read(given)


NOMINAL = "check force_*_N and [model.nominal] joint_compliance, which is in rad/(N m)"


def check_equilibrium(
    model: Model, table: Measurements, predicted: Array, remedy: str = NOMINAL
) -> None:
    bad = np.flatnonzero(~np.isfinite(predicted).all(axis=1))
    added = {p.effect for p in model.parameters}.intersection(CATALOGUE) - BUILT_IN
    remedy += f"; or {listed(sorted(added))} of a plug-in gives no number there" * bool(added)
    for i in bad[:1]:
        if added and not model.symbolic.arm.springs:
            no_number(table, i, listed(sorted(added)))
        raise InputError(
            f"{table.source}, line {table.row[i]}: no static equilibrium under this load "
            f"({len(bad)} rows); the compliances are too large for the force: {remedy}"
        )


def no_number(table: Measurements, row: int, what: str) -> NoReturn:
    told = "moves is no number there; look at the effect's expression and the row"
    raise InputError(f"{table.source}, line {table.row[row]}: what {what} {told}")


def _with_markers(cell: Cell, names: tuple[str, ...]) -> Cell:
    # All nominally at the flange's origin.
    return replace(cell, tool=replace(cell.tool, markers={name: np.zeros(3) for name in names}))


def _arrived(_: None, chain: Chain, cell: Cell, *more: Any) -> Model:
    lost = [choice.name for choice in cell.model.effects if choice.name not in CATALOGUE]
    told = f"the effect {listed(lost)} was registered where the model was pickled and does not"
    remedy = "travel with it; put it in a file that [plugins] of the cell names"
    require(not lost, f"{cell.source}: {told} {remedy}")
    return Model.assembled(chain, cell, *more)


def load_chain(cell: Cell) -> Chain:
    robot = cell.robot  # of one kind; a model in memory needs no reader at all
    if robot.mjcf is not None:
        from elastocal.model.mjcf import read_mjcf

        chain = read_mjcf(robot.mjcf, robot.base, robot.flange)
    elif robot.urdf is not None:
        from elastocal.model.urdf import read_urdf

        chain = read_urdf(robot.urdf, robot.base, robot.flange)
    elif robot.dh is not None:
        from elastocal.model.dh import read_dh

        chain = read_dh(robot.dh, robot.dh_convention, robot.masses, robot.ur_model)
    else:
        raise InputError(f"{cell.path}: [robot] needs urdf, mjcf or dh")
    return plausible(chain, robot.masses or robot.mjcf or robot.urdf or robot.dh)


@dataclass(frozen=True, kw_only=True)
class SmoothGroup(SmoothFunction):
    """Shrunk parameters that have one scale: those of a smooth function, or of an effect's place.

    `columns` (components, waves) index the model's parameters.  Where these are no function of one
    quantity, `follows` is "", and length and range are NaN.
    """

    effect: str
    where: str
    columns: IntArray

    @property
    def name(self) -> str:
        """ "joint curve of joint2", "residual field of link3, following joint1"."""
        text = f"{self.effect.replace('_', ' ')} of {self.where}"
        return text if self.follows in ("", self.where) else f"{text}, following {self.follows}"

    @property
    def joint(self) -> int:
        return index(self.follows)


def smooth_groups(model: Model) -> tuple[SmoothGroup, ...]:
    found: list[SmoothGroup] = []
    shrunk = [(k, p) for k, p in enumerate(model.parameters) if p.shrunk]
    for effect, where in dict.fromkeys((p.effect, p.where) for _, p in shrunk):
        group = partial(SmoothGroup, effect=effect, where=where)
        rest = {p.name: (k, p) for k, p in shrunk if (p.effect, p.where) == (effect, where)}
        for f in effect_of(effect).functions(where, model.chain, model.cell):
            columns = [[rest.pop(f"{where}.{key}")[0] for key in keys] for keys in f.keys]
            found.append(group(**vars(f), columns=np.array(columns)))
        for unit in dict.fromkeys(p.unit for _, p in rest.values()):
            alike = [(k, p) for k, p in rest.values() if p.unit == unit]
            size = float(np.sqrt(sum((p.typical or 0.0) ** 2 for _, p in alike)))
            columns = [[k for k, _ in alike]]
            found.append(group("", (), (unit,), size, columns=np.array(columns)))
    return tuple(found)


def where_smooth_functions_end(cell: Cell) -> str:
    """Up to where the cell's smooth functions correct the arm, "joint1 from -85.9° to 85.9°, …";
    empty where none ends."""
    effects = (type(effect_of(choice.name)) for choice in cell.model.effects)
    if all(effect.functions is Effect.functions for effect in effects):
        return ""  # the robot need not be read
    ends: dict[str, tuple[float, float]] = {}
    for group in smooth_groups(Model(cell, plugins=None)):
        if group.follows and not group.whole_turn:
            low, high = ends.get(group.follows, (group.low, group.high))
            ends[group.follows] = min(low, group.low), max(high, group.high)
    return ", ".join(
        f"{name} from {low:.0f} s to {high:.0f} s" if name == "time"
        else f"{name} from {np.degrees(low):.1f}° to {np.degrees(high):.1f}°"
        for name, (low, high) in sorted(ends.items())
    )  # fmt: skip


def effect_entries(cell: Cell | str | Path) -> list[dict[str, Any]]:
    """Per effect, stage by stage in the catalogue's order: name, what it is, places, parameters.

    Places and sizes are those of the cell's arm.  An effect that the cell fits is `on`.  A
    parameter's typical size is null where only the readings say it.
    """
    given = cell_of(cell)
    chain = load_chain(given)
    given = numbered(given, chain)
    on, entries = {choice.name for choice in given.model.effects}, []
    stages = list(dict.fromkeys(effect.stage for effect in CATALOGUE.values()))
    for effect in sorted(CATALOGUE.values(), key=lambda effect: stages.index(effect.stage)):
        where = effect.places(chain, given)
        first = inspect.cleandoc(type(effect).__doc__ or "").split("\n\n")[0]
        try:
            parameters = effect.parameters(where[0], chain, given) if where else ()
        except InputError:  # of link weights without masses: settings of the cell make them
            parameters = ()
        entries.append({
            "name": effect.name, "stage": effect.stage,
            "on": effect.name in on or effect.acts_unasked(given), "what": " ".join(first.split()),
            "places": list(where), "needs": list(effect.needed(given)),
            "parameters": [
                {"key": p.key, "unit": p.unit, "nominal": p.nominal, "typical": p.typical}
                for p in parameters
            ],
        })  # fmt: skip
    return entries
