"""What a diagnosis looks at: readings, their noise, and the columns of all possible additions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from elastocal.diagnosis.baseline import (
    Baseline,
    Blocks,
    from_centre,
    prior_deviations,
)
from elastocal.diagnosis.hypotheses import (
    KEPT,
    NO_SETTINGS,
    Columns,
    EntryKey,
    Hypothesis,
    RegressorDirection,
    SettingsGrid,
    compute_columns,
    grid_of,
    judged_together,
    moments_between,
    recorded,
)
from elastocal.diagnosis.noise_floor import NoisyData
from elastocal.errors import InsufficientDataError
from elastocal.identification.noise_structure import TIME, stated_deviations
from elastocal.identification.start import as_placed
from elastocal.measurements import Measurements, numbered
from elastocal.model.arm import usual_sizes
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.effects.loads import PayloadError
from elastocal.model.effects.placements import BaseFrame
from elastocal.model.manipulator import Model
from elastocal.model.observations import subset
from elastocal.units import Array, BoolArray, IntArray

# The load hangs on a flange frame that the markers' freedom leaves undetermined to millimetres.
LOAD_POINT_TOLERANCE = 2e-3


@dataclass(frozen=True)
class DiagnosisData:
    """A baseline with the columns of all hypotheses, packed by configuration.

    `data` holds the residual at the prior's centre, linearised at the fit, the fitted columns
    (scaled to their prior deviations) and noise shapes; `fitted` names the parameter of each of
    these columns, of the load point's the effect, of a stated drift's that of the base.
    `load_point` (C, m, 3) is what a shift of the load point does, per m, None without a load.
    `other_backlash` is the probability that play follows the backlash model that the base's model
    does not have.
    """

    base: Baseline
    columns: Columns
    hypotheses: tuple[Hypothesis, ...]
    data: NoisyData
    fitted: tuple[str, ...]
    load_point: Array | None = None
    other_backlash: float = 0.0

    @property
    def blocks(self) -> Blocks:
        return self.data.blocks

    @property
    def drift(self) -> float:
        """The drift in m that the cell states, and that is noise here; of distances none is."""
        return self.base.model.cell.noise.drift if self.blocks.size > 1 else 0.0

    @property
    def table(self) -> Measurements:
        return self.base.observed.table

    @property
    def lead(self) -> IntArray:
        """Row (N,) of the table that each observation stands in first."""
        return self.base.observed.lead

    @cached_property
    def kind(self) -> IntArray:
        """The marker and load of each observation (N,), numbered."""
        return numbered(self.table.marker[self.lead], self.base.observed.load)

    @cached_property
    def visit_table(self) -> Measurements:
        """One row for each visit (C·v), the first of its readings."""
        return self.table.take(self.lead[np.maximum(self.blocks.example, 0)].ravel())

    @property
    def present(self) -> BoolArray:
        """Which of the visits' places (C, v) hold one."""
        return self.blocks.example >= 0

    def pack(self, rows: Array) -> Array:
        """Per table row (n_rows, size, k) → packed (C, m, k)."""
        return self.blocks.pack(self.columns.observed(rows))

    def entry(self, key: EntryKey) -> Array:
        """Packed columns (C, m, d) of an entry; not to be written to."""
        known = self.columns.packed
        if key not in known:
            known[key] = self.pack(self.columns.entry(key))
        return known[key]

    @cached_property
    def sizes(self) -> dict[tuple[str, str], Array]:
        return {
            h.key: np.array([p.typical or 0.0 for p in h.parameters]) if h.driven
            else self.sizes_in(h, self.columns.of(h))
            for h in self.hypotheses
        }  # fmt: skip

    def sizes_in(self, h: Hypothesis, rows: Array) -> Array:
        """Its typical sizes by columns (n_rows, size, k), what is only planned not counted."""
        return usual_sizes(h.parameters, self.columns.observed(rows)[: self.base.n_measured])

    @cached_property
    def directions(self) -> dict[tuple[str, str], RegressorDirection]:
        chain, cell = self.base.model.chain, as_placed(self.base.model, self.base.x)
        known, driven = self.columns.regressors, [h for h in self.hypotheses if h.driven]
        for h in driven:
            if h.key not in known:
                known[h.key] = RegressorDirection(h, chain, cell)
        return {h.key: known[h.key] for h in driven}

    @cached_property
    def grids(self) -> dict[tuple[str, str], SettingsGrid]:
        table = self.visit_table.take(self.present.ravel())
        grids = {h.key: grid_of(h, table) for h in self.hypotheses if h.driven}
        for key, share in self.columns.shares.items():
            grids[key] = replace(NO_SETTINGS, log_prior=np.array([share]))
        return grids

    @cached_property
    def moments(self) -> Array:
        """Every moment at which something may have changed between two visits; none without
        times."""
        time = self.visit_table.time
        return np.zeros(0) if time is None else moments_between(time[self.present.ravel()])

    def direction(self, h: Hypothesis, settings: Array) -> Array:
        """D (C, v, d, G, k) at each visit, per typical size, at `settings` (G, …); (C, 1, d, G, k)
        where it is the same in all visits of a configuration."""
        key = *h.key, settings.tobytes()
        known = self.columns.directions
        if key in known:
            return known[key]
        visits, present = self._driven_visits[h.key]
        D = self.directions[h.key](visits, settings)
        D = D.reshape(*present.shape, *D.shape[1:]).transpose(0, 1, 3, 2, 4)
        D = np.multiply(D, self.sizes[h.key], order="C")
        D[~present] = 0.0
        if D.size + sum(other.size for other in known.values()) <= KEPT:
            known[key] = D
        return D

    @cached_property
    def _driven_visits(self) -> dict[tuple[str, str], tuple[Measurements, BoolArray]]:
        """Of each driven hypothesis the visits (C·v) that its direction is evaluated at and which
        of them there are (C, v): one of each configuration where it is the same in the others."""
        every, present = self.visit_table, self.present
        first = np.zeros_like(present)
        first[:, 0] = True
        one_each = every.take(first.ravel())
        out = {}
        for key, direction in self.directions.items():
            asked = direction.asked(every).reshape(*present.shape, -1)
            same = (asked == asked[:, :1]) | ~present[:, :, None]
            out[key] = (one_each, present[:, :1]) if same.all() else (every, present)
        return out

    def packed(self, h: Hypothesis, settings: Array) -> Array:
        """Columns (C, m, k) of a hypothesis at one value of its `settings` (…,), scaled; not to be
        written to."""
        size = self.sizes[h.key]
        if not h.driven:
            known = self.columns.packed
            if h.key not in known:
                known[h.key] = self.pack(self.columns.of(h)) * size
            return known[h.key]
        D = self.directions[h.key](self.table, settings[None])[:, 0]
        return self.pack(self.columns.entry(h.entry_key(self.base.model)) @ D) * size

    @cached_property
    def moment(self) -> Array:
        """When each observation (N,) was made; its row in the table where no times are recorded."""
        time = self.table.time
        return self.lead.astype(float) if time is None else time[self.lead]

    def without(self, faulty: BoolArray) -> DiagnosisData:
        """The same with the observations where `faulty` (N,) holds left out."""
        if (faulty == self.data.faulty).all():
            return self
        return replace(self, data=self.data.without(faulty))


def diagnosis_data_of(
    base: Baseline,
    hypotheses: list[Hypothesis],
    around: Model | None = None,
    x: Array | None = None,
    apart: bool = False,
) -> DiagnosisData:
    """Compute all columns at the baseline's fit and gather them by configuration.

    `around` is the base's model with some of the hypotheses in it, at its values x: columns are
    those there, and the residual is the baseline's.  `apart`: those of the base's own parameters
    are without the hypotheses.
    """
    model, observed, blocks = base.model, base.observed, base.blocks
    loads = _load_hypotheses(base)
    together = (h for h in judged_together(model, observed.table) if not h.driven)
    asked = list({h.key: h for h in (*loads, *together, *hypotheses)}.values())
    if around is None or x is None:
        around, x = model, base.x
    columns = compute_columns(base, asked, dict(zip(around.names, x, strict=True)))
    if apart:
        around, x = model, base.x
    own = np.array([around.names.index(name) for name in model.names], dtype=np.int64)
    at = around.regressor(observed.table, x, own, observed)
    width = prior_deviations(base)
    names = list(model.names)
    B = at.B.reshape(len(observed.lead), observed.size, -1) * width
    residual = base.residual.reshape(-1, observed.size) + B @ (from_centre(base) / width)
    load_point = None
    for h in loads:
        keys = [k for k, p in enumerate(h.parameters) if p.key.startswith("load_point")]
        shift = columns.observed(columns.of(h)[:, :, keys])
        load_point = blocks.pack(shift)
        B = np.concatenate([B, shift * LOAD_POINT_TOLERANCE], axis=2)
        names += [h.name] * len(keys)
    drift, faster = _stated_drift(base)
    B = np.concatenate([B, drift], axis=2)
    names += [BaseFrame.name] * drift.shape[2]
    used = np.abs(B).max(axis=(0, 1), initial=0.0) > 0
    if not used.any():
        raise InsufficientDataError(
            f"{observed.table.source}: these readings show nothing that the model has: no "
            "parameter moves a marker in any pose under these loads; check robot, poses and loads, "
            "or measure others"
        )
    B = B[:, :, used]
    joints = tuple(f"joint{i + 1}" for i in range(model.chain.n_joints))
    data = NoisyData(
        blocks=blocks,
        r=blocks.pack(residual[:, :, None])[:, :, 0],
        X=blocks.pack(B),
        precision=np.ones(B.shape[2]),
        covariance=blocks.pack_square(base.covariance) + faster,
        G=blocks.pack(columns.entry(("joint_motion", joints))[observed.lead]),
        left_out=blocks.absent,
        stated=base.stated is not None,
    )
    fitted = tuple(n for n, u in zip(names, used, strict=True) if u)
    return DiagnosisData(base, columns, tuple(hypotheses), data, fitted, load_point)


def _stated_drift(base: Baseline) -> tuple[Array, Array | float]:
    """Columns (N, size, k) of the drift that the cell's [noise] states, coefficients of variance
    one, and the covariance (C, m, m) of what changes faster than its waves.

    It is noise that neighbours in time have in common: left out, it passes for an effect that goes
    with time.
    """
    observed, blocks = base.observed, base.blocks
    n, size, found = len(observed.lead), observed.size, []
    if base.model.cell.noise.drift:
        some = subset(observed, np.arange(n) < base.n_measured)
        found = stated_deviations(base.model, some, base.x, (TIME,))
    if not found:
        return np.zeros((n, size, 0)), 0.0
    waves = found[0].waves
    assert waves is not None
    drift = np.concatenate([waves, np.zeros((n - base.n_measured, *waves.shape[1:]))])
    loading = found[0].packed(np.where(blocks.member < base.n_measured, blocks.member, -1))
    return drift, loading @ loading.transpose(0, 2, 1)


def _load_hypotheses(base: Baseline) -> list[Hypothesis]:
    """The load's own error, whose load point has a tolerance in any case."""
    effect, model = CATALOGUE[PayloadError.name], base.model
    acting = recorded(base.observed.table, "load") and model.cell.model.torque != "measured"
    if not acting or any(p.effect == effect.name for p in model.parameters):
        return []
    return [
        Hypothesis(effect, w, effect.parameters(w, model.chain, model.cell), ())
        for w in effect.places(model.chain, model.cell)
    ]
