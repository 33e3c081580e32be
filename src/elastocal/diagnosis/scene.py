"""Everything that a diagnosis looks at: readings in blocks, fitted columns, what could be added."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.blocks import Blocks, VisitPlaces
from elastocal.diagnosis.columns import (
    Columns,
    Drive,
    EntryKey,
    compute_columns,
    entry_key,
    is_driven,
    typical_sizes,
)
from elastocal.diagnosis.hypotheses import Hypothesis, recorded
from elastocal.diagnosis.noise import NoiseValues, NoisyData
from elastocal.diagnosis.noise_fit import fit_noise
from elastocal.diagnosis.settings_grid import Grid, grid_of, moments_between
from elastocal.identification.solve import is_placed
from elastocal.manipulator.effects import CATALOGUE, effect_of
from elastocal.manipulator.effects.loads import PayloadError
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Prior standard deviations of the fitted parameters about the fit, in typical sizes: wide enough
# to leave them to the data, narrow enough that what no reading shows stays where it is.
FITTED, FITTED_COMPLIANCE = 5.0, 1.0
# m or rad: base and markers.  The fit has placed them, but an error that it took for another
# geometry may have moved them by as much; the true effect must be free to bring them back.
PLACED = 0.1
KEPT = 20_000_000  # numbers of a search's drives that are kept from scan to scan
# The load hangs on a flange frame that the markers' freedom leaves undetermined to millimetres.
LOAD_POINT_TOLERANCE = 2e-3


@dataclass(frozen=True)
class FittedColumns:
    """What the columns of the data's X are: `effect` of each, `width` (p,) that scales it."""

    effect: tuple[str, ...]
    width: Array


@dataclass(frozen=True)
class Scene:
    """A baseline with the columns of all hypotheses, packed by configuration.

    `data` holds the residual at the prior's centre, linearised at the fit, the fitted columns
    (scaled to their prior deviations) and noise shapes; `load_point` (C, m, 3) what a shift of the
    hook does, per m, None without a load.  `other_play` is the probability that play follows the
    law that the base's model does not have.
    """

    base: Baseline
    columns: Columns
    hypotheses: tuple[Hypothesis, ...]
    blocks: Blocks
    places: VisitPlaces
    data: NoisyData
    fitted: FittedColumns
    load_point: Array | None = None
    other_play: float = 0.0

    @cached_property
    def _packed(self) -> dict[EntryKey | tuple[str, str], Array]:
        return {}

    @cached_property
    def _kept(self) -> dict[tuple[str, str, bytes], Array]:
        return {}

    @cached_property
    def noise(self) -> NoiseValues:
        """The most probable noise beside the fitted parameters alone."""
        return fit_noise(self.data)

    @cached_property
    def visit_table(self) -> Measurements:
        """One row for each visit (C·v), the first of its readings."""
        return self.base.seen.table.take(
            self.base.seen.lead[np.maximum(self.places.example, 0)].ravel()
        )

    @property
    def present(self) -> Mask:
        """Which of the visits' places (C, v) hold one."""
        return self.places.example >= 0

    def pack(self, rows: Array) -> Array:
        """Per table row (n_rows, size, k) → packed (C, m, k)."""
        return self.blocks.pack(self.columns.observed(rows))

    def entry(self, key: EntryKey) -> Array:
        """Packed columns (C, m, d) of an entry; not to be written to."""
        if key not in self._packed:
            self._packed[key] = self.pack(self.columns.entry(key))
        return self._packed[key]

    @cached_property
    def sizes(self) -> dict[tuple[str, str], Array]:
        """Typical size of every hypothesis' parameters, by effect and place."""
        return {(h.name, h.where): self._sizes(h) for h in self.hypotheses}

    def _sizes(self, h: Hypothesis) -> Array:
        if is_driven(h):
            return np.array([p.typical or 0.0 for p in h.parameters])
        measured = self.columns.observed(self.columns.of(h))[: self.base.n_measured]
        return typical_sizes(h, measured)

    @cached_property
    def drives(self) -> dict[tuple[str, str], Drive]:
        return {
            (h.name, h.where): Drive(h, self.base.model) for h in self.hypotheses if is_driven(h)
        }

    @cached_property
    def grids(self) -> dict[tuple[str, str], Grid]:
        """Settings that are searched, by effect and place."""
        table, model = self.visit_table.take(self.present.ravel()), self.base.model
        return {
            (h.name, h.where): grid_of(h, table, model.chain)
            for h in self.hypotheses
            if is_driven(h)
        }

    @cached_property
    def moments(self) -> Array:
        """Every moment at which something may have changed between two visits; none without
        times."""
        time = self.visit_table.time
        return np.zeros(0) if time is None else moments_between(time[self.present.ravel()])

    def drive(self, h: Hypothesis, settings: Array) -> Array:
        """D (C, v, d, G, k) at each visit, per typical size, at `settings` (G, …); (C, 1, d, G, k)
        where all visits of a configuration are driven alike."""
        key = h.name, h.where, settings.tobytes()
        if key in self._kept:
            return self._kept[key]
        visits, present = self._driven_visits[h.name, h.where]
        D = self.drives[h.name, h.where](visits, settings) * self.sizes[h.name, h.where]
        D = D.reshape(*present.shape, *D.shape[1:]) * present[:, :, None, None, None]
        D = np.ascontiguousarray(D.transpose(0, 1, 3, 2, 4))
        if D.size + sum(kept.size for kept in self._kept.values()) <= KEPT:
            self._kept[key] = D
        return D

    @cached_property
    def _driven_visits(self) -> dict[tuple[str, str], tuple[Measurements, Mask]]:
        """Of each driven hypothesis the visits (C·v) that its drive is evaluated at and which of
        them there are (C, v): one of each configuration where the others are driven alike."""
        every, present = self.visit_table, self.present
        first = np.zeros_like(present)
        first[:, 0] = True
        one_each = every.take(first.ravel())
        out = {}
        for key, drive in self.drives.items():
            asked = drive.asked(every).reshape(*present.shape, -1)
            alike = (asked == asked[:, :1]) | ~present[:, :, None]
            out[key] = (one_each, present[:, :1]) if alike.all() else (every, present)
        return out

    def packed(self, h: Hypothesis, settings: Array) -> Array:
        """Columns (C, m, k) of a hypothesis at one value of its `settings` (…,), scaled; not to be
        written to."""
        size = self.sizes[h.name, h.where]
        if not is_driven(h):
            if (h.name, h.where) not in self._packed:
                self._packed[h.name, h.where] = self.pack(self.columns.of(h)) * size
            return self._packed[h.name, h.where]
        D = self.drives[h.name, h.where](self.base.seen.table, settings[None])[:, 0]
        rows = self.columns.entry(entry_key(h, self.base.model)) @ D
        return self.pack(rows) * size

    def changed(self, **changes: Any) -> Scene:
        """The same readings seen otherwise: their noise beside the fitted parameters stays."""
        other = replace(self, **changes)
        if "noise" in self.__dict__:
            other.__dict__["noise"] = self.noise
        return other

    def without(self, faulty: Mask) -> Scene:
        """The same with the observations where `faulty` (N,) holds left out."""
        if (faulty == self.data.faulty).all():
            return self
        return replace(self, data=self.data.without(faulty))


def scene_of(
    base: Baseline,
    hypotheses: list[Hypothesis],
    around: Model | None = None,
    x: Array | None = None,
) -> Scene:
    """Compute all columns at the baseline's fit and gather them by configuration.

    `around` is the base's model with some of the hypotheses in it, at its values x: columns are
    those there, and the residual is the baseline's.
    """
    model, seen = base.model, base.seen
    hook = _load_hypothesis(base)
    known = {(h.name, h.where) for h in hypotheses}
    asked = [*hypotheses, *(h for h in hook if (h.name, h.where) not in known)]
    if around is None or x is None:
        around, x = model, base.x
    columns = compute_columns(base, asked, dict(zip(around.names, x, strict=True)))
    blocks = base.blocks
    own = np.array([around.names.index(name) for name in model.names], dtype=np.int64)
    at = around.regressor(seen.table, x, own, seen)
    width = widths(base)
    effects = [p.effect for p in model.parameters]
    B = at.B.reshape(len(seen.lead), seen.size, -1) * width
    residual = base.residual.reshape(-1, seen.size) + B @ (away(base) / width)
    load_point = None
    for h in hook:
        keys = [k for k, p in enumerate(h.parameters) if p.key.startswith("load_point")]
        shift = columns.observed(columns.of(h)[:, :, keys])
        load_point = blocks.pack(shift)
        B = np.concatenate([B, shift * LOAD_POINT_TOLERANCE], axis=2)
        width = np.append(width, np.full(len(keys), LOAD_POINT_TOLERANCE))
        effects = effects + [h.name] * len(keys)
    used = np.abs(B).max(axis=(0, 1), initial=0.0) > 0
    B = B[:, :, used]
    n_joints = model.chain.n_joints
    names = [("joint_motion", f"joint{i + 1}") for i in range(n_joints)]
    G = np.concatenate([columns.rows[:, :, columns.places[k]] for k in names], axis=2)[seen.lead]
    stated = base.stated
    if stated is None:
        each = base.residual.reshape(-1, seen.size)
        stated = np.tile(np.diag(np.maximum(each.var(axis=0), 1e-18)), (len(each), 1, 1))
    data = NoisyData(
        blocks=blocks,
        r=blocks.pack(residual[:, :, None])[:, :, 0],
        X=blocks.pack(B),
        precision=np.ones(B.shape[2]),
        covariance=blocks.pack_square(stated),
        G=blocks.pack(G),
        same_visit=blocks.same_visit,
        left_out=blocks.absent,
        stated=base.stated is not None,
    )
    fitted = FittedColumns(tuple(e for e, u in zip(effects, used, strict=True) if u), width[used])
    return Scene(base, columns, tuple(hypotheses), blocks, blocks.places, data, fitted, load_point)


def away(base: Baseline) -> Array:
    """How far (parameters,) the fit is from the centre of the prior: nominal, but for what
    registration placed, which is where it is.

    An unmodelled effect bends parameters that little else holds; they must be free to return.
    """
    return np.where(is_placed(base.model), 0.0, base.x - base.model.nominal)


def widths(base: Baseline) -> Array:
    """Prior standard deviation (parameters,) of each fitted parameter."""
    compliant = [effect_of(p.effect).sized_by_value for p in base.model.parameters]
    wide = base.sizes * np.where(compliant, FITTED_COMPLIANCE, FITTED)
    return np.where(is_placed(base.model), PLACED, wide)


def _load_hypothesis(base: Baseline) -> list[Hypothesis]:
    """The load's own error, whose hook point has a tolerance in any case."""
    effect, model = CATALOGUE[PayloadError.name], base.model
    if not recorded(base.seen.table, "load") or model.cell.model.torque == "measured":
        return []
    if any(p.effect == effect.name for p in model.parameters):
        return []
    return [
        Hypothesis(effect, w, effect.parameters(w, model.chain, model.cell), ())
        for w in effect.places(model.chain, model.cell)
    ]
