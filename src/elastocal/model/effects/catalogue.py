"""The catalogue of effects (built in, registered), and the symbolic arm that a cell's effects make
of a chain: expressions, static equilibrium, B of a pose.

An effect is known by its name everywhere; what else other modules must know of it they ask it: see
the traits of `base.Effect`.  A new one is a class in the room of its stage and a line below, or a
file of the user's own that calls `register`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell, read_cell
from elastocal.files import load_installed, load_plugins, same_class
from elastocal.measurements import Measurements
from elastocal.messages import InputError, check_known, require
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects import geometry, smooth, statics
from elastocal.model.effects.base import Arm, Effect, Parameter, check, row_inputs
from elastocal.model.evaluate import BatchFunction
from elastocal.model.observations import observe
from elastocal.units import Array

# Effects act in this order: what sets a frame or a marker stands before what moves it.
CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in (
    geometry.BaseFrame(), geometry.JointOffset(), geometry.EncoderScale(),
    geometry.GearEccentricity(), geometry.GearSecondHarmonic(), geometry.GearRipple(),
    geometry.GearSpectrum(), smooth.JointCurve(), geometry.WristCoupling(), geometry.JointDrift(),
    geometry.EncoderJump(), geometry.MoveLag(), geometry.MoveHysteresis(), statics.GravitySag(),
    statics.TorqueCoupling(), geometry.LinkGeometry(), statics.TorqueTilt(),
    geometry.ThermalExpansion(), geometry.LinkJump(), statics.JointCompliance(),
    statics.JointHardening(), geometry.Backlash(), geometry.Hysteresis(), smooth.TorqueResponse(),
    smooth.ApproachResponse(), statics.OffAxisCompliance(), statics.LinkBending(),
    statics.BaseCompliance(), smooth.LoadResponse(), statics.GravityCompensator(),
    statics.LinkGravity(), statics.LinkMassError(), statics.LinkWeights(), statics.Payload(),
    statics.PayloadError(), geometry.MarkerPosition(), geometry.MarkerSlip(), geometry.ToolJump(),
    smooth.ResidualField(), smooth.ResidualStep(), geometry.MarkerOrientation(),
    geometry.BaseDrift(), geometry.FrameJump(), geometry.DistanceSensor(),
    geometry.TrackerDistortion(),
)}  # fmt: skip
BUILT_IN = frozenset(CATALOGUE)
UNKNOWN = Effect()  # what is known of an effect that the catalogue does not have


def effect_of(name: str) -> Effect:
    return CATALOGUE.get(name, UNKNOWN)


def register(effect: Effect) -> None:
    """Add an effect to the catalogue, behind the last one of its stage; the same class (in an
    edited notebook cell, say) takes the place of its former self.  InputError where it is no
    effect, says too little, or has the name of another one."""
    check(effect)
    known = CATALOGUE.get(effect.name)
    if known is not None:
        told = f"there is an effect '{effect.name}' already; choose another name"
        require(effect.name not in BUILT_IN and same_class(known, effect), told)
        CATALOGUE[effect.name] = effect
        return
    order = list(CATALOGUE.values())
    last = max(k for k, other in enumerate(order) if other.stage == effect.stage)
    order.insert(last + 1, effect)
    CATALOGUE.clear()
    CATALOGUE.update({each.name: each for each in order})


def cell_of(cell: Cell | str | Path, plugins: bool | None = False) -> Cell:
    """The cell itself, or that of a cell file; its plug-ins run where `plugins` or the environment
    allows it.  `plugins` None: they are done without where the catalogue has all effects of its
    model. InputError where the file is wrong, or names plug-ins that may not run."""
    fresh = not isinstance(cell, Cell)
    read = cell if isinstance(cell, Cell) else read_cell(cell)
    load_installed()
    if plugins is not None or any(each.name not in CATALOGUE for each in read.model.effects):
        load_plugins(Path(read.source), read.plugins, bool(plugins), fresh)
    if fresh:
        read.check(known_effects=tuple(CATALOGUE))
    return read


def choose_effects(chain: Chain, cell: Cell) -> list[tuple[Effect, str]]:
    """(effect, place) for everything active, in the catalogue's order.  The table's force always
    acts (`payload`); link weights act where `link_gravity` says so.  InputError for an unknown
    effect, place or setting, with the nearest valid one, and for an effect that has no place on
    this arm."""
    nominal = cell.model.nominal
    for table, what, given, keys_of in (
        ("settings", "setting", nominal.settings, lambda e, *at: [s.key for s in e.settings(*at)]),
        # Shrunk parameters have their size from a setting.
        ("sizes", "parameter", nominal.sizes,
         lambda e, *at: [p.key for p in e.parameters(*at) if not p.shrunk]),
    ):  # fmt: skip
        known: dict[str, list[str]] = {}
        for effect in CATALOGUE.values() if given else ():
            for place in effect.places(chain, cell):
                if keys := keys_of(effect, place, chain, cell):
                    known.setdefault(place, []).extend(keys)
        for place, values in given.items():
            _check_known(f"nominal.{table}", "place", place, known, cell)
            for key in values:
                _check_known(f"nominal.{table}", f"{what} of {place}", key, known[place], cell)
    for choice in cell.model.effects:
        _check_known("effects", "effect", choice.name, CATALOGUE, cell)
    chosen = []
    for name, effect in CATALOGUE.items():
        asked = [choice.where for choice in cell.model.effects if choice.name == name]
        if not (asked or effect.acts_unasked(cell)):
            continue
        places = effect.places(chain, cell)
        told = f"has no place on robot '{chain.name}' with observe = \"{cell.model.observe}\""
        require(places, f"{cell.source}: [model] effects: {name} {told}; leave it out")
        for where in filter(None, asked):
            _check_known("effects", f"place of {name}", where, places, cell)
        everywhere = None in asked or effect.acts_unasked(cell)
        chosen += [(effect, place) for place in places if everywhere or place in asked]
    return chosen


def set_constants(effect: Effect, place: str, chain: Chain, cell: Cell) -> dict[str, ca.SX]:
    """Values of the effect's settings at a place: the cell's, else their defaults.  InputError
    where one has neither, or lies outside its range."""
    given = cell.model.nominal.settings.get(place, {})
    values = {}
    for setting in effect.settings(place, chain, cell):
        value = given.get(setting.key, setting.default)
        where = f"{cell.source}: [model.nominal.settings.{place}] {setting.key}"
        if value is None:
            told = f"is missing, which {effect.name} at {place} needs; `elastocal diagnose`"
            raise InputError(f"{where} {told} searches for it")
        told = f"takes {setting.lower:g} to {setting.upper:g}; found {value:g}"
        require(setting.lower <= value <= setting.upper, f"{where} {told}")
        values[setting.key] = ca.SX(value)
    return values


def _check_known(key: str, what: str, found: str, valid: Collection[str], cell: Cell) -> None:
    check_known(found, valid, f"{cell.source}: [model] {key}: unknown {what} '{found}'", "valid:")


MAX_STEPS = 30
LARGEST = 0.5  # rad or m
TOLERANCE = 1e-14  # rad (m for prismatic springs); Newton converges quadratically past it
KEPT, FEW = 6, 20_000  # answers that are kept, of so many numbers: fits come back to half of them


class Recent:
    """The last answers to questions of few numbers; what a caller does to one changes no other."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Hashable, ...], tuple[NDArray, NDArray]] = {}

    def __call__(
        self, asked: Sequence[Hashable], given: Sequence[NDArray],
        answer: Callable[[], tuple[NDArray, NDArray]],
    ) -> tuple[NDArray, NDArray]:  # fmt: skip
        if sum(x.size for x in given) > FEW:
            return answer()
        key = (*asked, *(x.tobytes() for x in given))
        found = self._kept.get(key)
        if found is None:
            found = answer()
            # Bound anew, not changed: threads may look it up at the same time.
            self._kept = dict([*self._kept.items()][1 - KEPT :]) | {key: found}
        return found[0].copy(), found[1].copy()


class SymbolicArm:
    """h(inputs, X, θ) and F(inputs, X, θ) = θ − law(τ) of one row, as CasADi expressions.
    `parameters` are those of all active effects, in order; `arm.inputs` what a row must give.
    `extra` effects with their places act besides those that the cell chooses.  `backend` is that of
    its functions."""

    def __init__(
        self, chain: Chain, cell: Cell, extra: Sequence[tuple[Effect, str]] = (),
        backend: str | None = None,
    ) -> None:  # fmt: skip
        arm = Arm(chain, cell)
        chosen = [*choose_effects(chain, cell), *extra]
        symbols: list[ca.SX] = []
        bound, known = [], dict[str, Parameter]()
        for effect, place in chosen:
            own = set_constants(effect, place, chain, cell)
            sizes = cell.model.nominal.sizes.get(place, {})
            for spec in effect.parameters(place, chain, cell):
                if spec.key in sizes and not spec.shrunk:
                    spec = replace(spec, typical=sizes[spec.key])
                own[spec.key] = ca.SX.sym(f"{place}.{spec.key}")
                symbols.append(own[spec.key])
                name = f"{place}.{spec.key}"
                p = Parameter(**vars(spec), name=name, effect=effect.name, where=place)
                other = known.setdefault(name, p)
                told = f"the effects {other.effect} and {p.effect} both have a parameter '{name}';"
                remedy = "give the one that you registered a key of its own"
                require(other is p, f"{cell.source}: {told} {remedy}")
            bound.append((effect, place, own))
        for effect, place, own in bound:
            effect.shape(arm, place, own)
        arm.assemble()
        for effect, place, own in bound:
            effect.load(arm, place, own)
        for effect, place, own in bound:
            effect.read(arm, place, own)
        self.arm = arm
        self.backend = backend
        self.parameters = tuple(known.values())
        self.p = ca.vertcat(ca.SX.zeros(0, 1), *symbols)
        # The reading h of one row (3, 6 or 1 components) in inputs, X and θ.
        kind = cell.model.observe
        self.reading = arm.reading["distance" if kind == "distance" else "position"]
        if kind == "pose":
            measured = rigid.rotation_from_vector(arm.input("rotation", 3))
            turned = rigid.vector_from_rotation(measured.T @ arm.reading["rotation"])
            self.reading = ca.vertcat(self.reading, turned)
        self._recent = Recent()
        # Deflections by eq. (3), or by the equilibrium F(θ) = 0.
        self._linear = bool(arm.springs) and cell.model.deflection_model == "linear"
        self.implicit = bool(arm.springs) and not self._linear

    @cached_property
    def residual(self) -> ca.SX:
        """F = θ − law(τ(θ)) (springs,), zero at the equilibrium."""
        arm = self.arm
        tau = -ca.gradient(arm.potential, arm.theta)  # of the loads on each spring
        return arm.theta - ca.vertcat(*[s.law(tau[k]) for k, s in enumerate(arm.springs)])

    def explicit(self, expression: ca.SX, steps: int) -> ca.SX:
        """`expression` of inputs, X and θ as one of inputs and X alone: deflections by eq. (3)
        where the model is linear, else after `steps` fixed-point steps θ ← law(τ(θ)) from rest,
        each of which divides the error by the ratio of a joint's stiffness to the change of the
        load's torque with its angle (a hundred and more)."""
        theta = self.arm.theta
        law, settled = theta - self.residual, ca.SX.zeros(theta.shape[0], 1)
        if self._linear:  # h(0) + ∂h/∂θ · law(τ(0)), loads and lever arms of the undeflected pose
            y = ca.vec(expression)
            # At once: what they have in common stays one.
            at_rest = ca.substitute([y, ca.jacobian(y, theta), law], [theta], [settled])
            return ca.reshape(at_rest[0] + at_rest[1] @ at_rest[2], *expression.shape)
        if not self.implicit:
            return expression
        for _ in range(steps):
            settled = ca.substitute(law, theta, settled)
        return ca.substitute(expression, theta, settled)

    @cached_property
    def _equations(self) -> BatchFunction:
        theta = self.arm.theta
        outputs = [self.residual, ca.jacobian(self.residual, theta)]  # F and F_θ
        return BatchFunction([*self.arm.inputs.values(), self.p, theta], outputs, self.backend)

    def equilibrium(self, inputs: Sequence[NDArray], p: NDArray) -> tuple[NDArray, NDArray]:
        """Deflections θ (n, springs) with F(θ) = θ − law(τ(θ)) = 0, τ = −∂V/∂θ at the deflected
        pose, by Newton's method on all rows, and F_θ (n, springs, springs) there; p (parameters,),
        or (n, parameters) by row.  Zeros where the model is linear or rigid.

        Written with compliances, so a rigid joint (k = 0) needs no special case.  Only a stable
        equilibrium with deflections below LARGEST counts: beyond that no arm is elastic any more.
        Rows that do not settle become NaN, with F_θ = 1 so that it can still be solved with.
        """
        if self.implicit:
            return self._recent((), [p, *inputs], lambda: self._of_visits(inputs, p))
        n, size = len(inputs[0]), len(self.arm.springs)
        return np.zeros((n, size), dtype=p.dtype), np.zeros((n, size, size))

    def _of_visits(self, inputs: Sequence[NDArray], p: NDArray) -> tuple[NDArray, NDArray]:
        """The same, once for rows one after the other that differ in nothing that bends the arm, as
        those of several markers do."""
        new = np.ones(len(inputs[0]), dtype=bool)
        felt = (a for a, acts in zip([*inputs, p], self._acting, strict=True) if acts)
        new[1:] = sum((a[1:] != a[:-1]).any(axis=1) for a in felt if a.ndim == 2) > 0
        at, begun = np.cumsum(new) - 1, np.flatnonzero(new)
        *given, values = (a[begun] if a.ndim == 2 else a for a in (*inputs, p))
        theta, slope = self._settled(given, values)
        return theta[at], slope[at]

    @cached_property
    def _acting(self) -> list[bool]:
        """Which of the inputs, and the parameters, the equilibrium depends on."""
        symbols = [*self.arm.inputs.values(), self.p]
        return [bool(s.numel()) and ca.depends_on(self.residual, s) for s in symbols]

    def _settled(self, inputs: Sequence[NDArray], p: NDArray) -> tuple[NDArray, NDArray]:
        n, size = len(inputs[0]), len(self.arm.springs)
        theta = np.zeros((n, size), dtype=np.result_type(np.float64, p, *inputs))
        # Where the last step was taken: that step is rounding, so F_θ is that of θ.
        slope = np.full((n, size, size), np.nan, dtype=theta.dtype)
        active = np.arange(n)
        for _ in range(MAX_STEPS):
            if not len(active):
                break
            *given, at = [a[active] if a.ndim == 2 else a for a in (*inputs, p)]
            F, F_theta = self._equations(*given, at, theta[active])
            finite = np.isfinite(F_theta).all(axis=(1, 2)) & np.isfinite(F[..., 0]).all(axis=1)
            theta[active[~finite]] = np.nan
            active, F, F_theta = active[finite], F[finite], F_theta[finite]
            try:
                step = np.linalg.solve(F_theta, F)[..., 0]
            except np.linalg.LinAlgError:  # a pose at the verge of buckling
                break
            theta[active] -= step
            slope[active] = F_theta
            settled = np.abs(step).max(axis=1) <= TOLERANCE + 1e-12 * np.abs(theta[active]).max(1)
            active = active[~settled]
        theta[active] = np.nan
        with np.errstate(invalid="ignore"):
            theta[(np.abs(theta.real) > LARGEST).any(axis=1)] = np.nan
        # F_θ = 1 − C·H with the potential's Hessian H: a minimum while its eigenvalues are
        # positive, which they are wherever C·H is small; only soft poses need the eigenvalues.
        soft = np.abs(slope.real - np.eye(size)).sum(axis=2).max(axis=1) >= 1
        rows = np.flatnonzero(soft & np.isfinite(slope.real).all(axis=(1, 2)))
        theta[rows[np.linalg.eigvals(slope.real[rows]).real.min(axis=1) <= 0]] = np.nan
        slope[~np.isfinite(theta).all(axis=1)] = np.eye(size)
        return theta, slope

    def _of_rows(self, *outputs: ca.SX) -> BatchFunction:
        inputs = [*self.arm.inputs.values(), self.p, self.arm.theta]
        return BatchFunction(inputs, [self.settled(y) for y in outputs], self.backend)

    @cached_property
    def readings(self) -> BatchFunction:
        return self._of_rows(self.reading)

    @cached_property
    def frames(self) -> BatchFunction:
        reading = self.arm.reading
        return self._of_rows(self.arm.T_tracker_flange, reading["position"], reading["rotation"])

    @cached_property
    def regressor(self) -> Total:
        return Total(self, self.reading, self.p)

    def settled(self, y: ca.SX) -> ca.SX:
        """y by eq. (3) where the model is linear, else in X and θ."""
        return y if self.implicit else self.explicit(y, 0)


class Total:
    """y(inputs, X, extra; θ) and dy/dz at the static equilibrium F(inputs, X; θ) = 0.

    dy/dz = ∂y/∂z − ∂y/∂θ F_θ⁻¹ ∂F/∂z, by the adjoint λ = F_θ⁻ᵀ (∂y/∂θ)ᵀ as the partial derivative
    of y − λᵀF: a few reverse sweeps instead of all of ∂F/∂z.  `y` (m, 1) and `z` (k, 1) are
    expressions of `arm`, evaluated by its backend; `extra` are further symbols in y.  Where the
    model is linear (eq. 3) or rigid, y is explicit and nothing is solved.
    """

    def __init__(self, arm: SymbolicArm, y: ca.SX, z: ca.SX, extra: Sequence[ca.SX] = ()) -> None:
        self._arm, self._y, self._z = arm, arm.settled(y), z
        self._inputs = [*arm.arm.inputs.values(), *extra, arm.p, arm.arm.theta]
        self._functions: dict[tuple[int, ...], BatchFunction] = {}
        self._recent = Recent()

    @cached_property
    def _derivative(self) -> tuple[ca.SX, ca.SX]:
        """Symbols λ (m, springs), none without an equilibrium, and dy/dz."""
        arm = self._arm
        adjoint = ca.SX.sym("adjoint", self._y.shape[0], arm.arm.theta.shape[0])
        lagrangian = self._y - adjoint @ arm.residual if arm.implicit else self._y
        return adjoint, ca.jacobian(lagrangian, self._z)

    @cached_property
    def _slopes(self) -> BatchFunction:
        outputs = [ca.jacobian(self._y, self._arm.arm.theta)]
        return BatchFunction(self._inputs, outputs, self._arm.backend)

    def _function(self, columns: tuple[int, ...]) -> BatchFunction:
        if columns not in self._functions:
            adjoint, slope = self._derivative
            inputs = [*self._inputs, *([ca.vec(adjoint.T)] if self._arm.implicit else [])]
            outputs = [self._y, slope[:, list(columns)]]
            self._functions[columns] = BatchFunction(inputs, outputs, self._arm.backend)
        return self._functions[columns]

    def __call__(
        self, inputs: list[NDArray], x: Array, extra: Sequence[NDArray] = (),
        columns: tuple[int, ...] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """y (n, m) and dy/dz (n, m, columns) of every row; y is NaN where there is no equilibrium.
        `columns` are those of z, by default all."""
        asked = tuple(range(self._z.shape[0])) if columns is None else columns
        arm, given = self._arm, [*inputs, *extra, x]

        def evaluated() -> tuple[Array, Array]:
            function, (theta, F_theta) = self._function(asked), arm.equilibrium(inputs, x)
            if not arm.implicit:
                y, slope = function(*given, theta)
                return y[..., 0], slope
            y_theta = self._slopes(*given, theta)[0]
            y_theta[~np.isfinite(y_theta).all(axis=(1, 2))] = 0.0
            adjoint = np.linalg.solve(F_theta.transpose(0, 2, 1), y_theta.transpose(0, 2, 1))
            adjoint = adjoint.transpose(0, 2, 1).reshape(len(theta), -1)
            y, slope = function(*given, theta, adjoint)
            y[~np.isfinite(theta).all(axis=1)] = np.nan
            return y[..., 0], slope

        return self._recent(asked, given, evaluated)


# Fixed-point steps to the equilibrium.  Under 280 kg on a KR 270 they leave 2·10⁻⁴ of a column.
STEPS = 2


def configuration_rows(
    symbolic: SymbolicArm, template: Measurements, columns: NDArray[np.int64]
) -> tuple[ca.Function, ca.Function]:
    """B (rows, columns) = ∂prediction/∂X of the configuration whose rows `template` lists, all its
    markers and load states, as a function of q (n,) and X (parameters,); and its adjoint, (q, X, W)
    → ∇_q Σ_ij W_ij B_ij (n,), one reverse sweep, for W (rows, columns).

    Rows are those of `Model.regressor` on the template, which gives everything but q.  Deflections
    are explicit functions of q and X: eq. (3) for a linear model, STEPS fixed-point steps for the
    equilibrium.  Where poses are observed, the rotation is taken as measured without error.
    """
    arm, p = symbolic.arm, symbolic.p
    observed = observe(template, arm.cell.model.observe)
    B = ca.jacobian(symbolic.explicit(symbolic.reading, STEPS), p)[:, list(columns)]
    if arm.cell.model.observe == "pose":
        # Substituted after differentiation: the measured rotation is data, not a prediction.
        predicted = symbolic.explicit(arm.reading["rotation"], STEPS)
        B = ca.substitute(B, arm.inputs["rotation"], rigid.vector_from_rotation(predicted))
    # (inputs …, X) → B of one table row (size, columns)
    row = ca.Function("row", [*arm.inputs.values(), p], [B], {"cse": True})
    q = ca.SX.sym("q", arm.chain.n_joints)
    given = dict(zip(arm.inputs, row_inputs(arm, template), strict=True))
    rows = []
    for i in range(len(template)):
        own = [q if name == "q" else ca.SX(ca.DM(value[i])) for name, value in given.items()]
        rows.append(row(*own, p))
    combined = (
        sum((float(w) * rows[i] for i, w in zip(line.indices, line.data, strict=True)), ca.SX(0))
        for line in (observed.combine[[k]] for k in range(observed.combine.shape[0]))
    )
    B = ca.vertcat(*combined)
    W, cse = ca.SX.sym("W", *B.shape), {"cse": True}
    gradient = ca.gradient(ca.dot(W, B), q)
    return ca.Function("B", [q, p], [B], cse), ca.Function("adjoint", [q, p, W], [gradient], cse)
