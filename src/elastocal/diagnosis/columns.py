"""Columns of every hypothesis at the fitted arm: one symbolic model with everything in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_cache import made_once
from elastocal.diagnosis.tangent import tangents, with_tangents
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.effects.compliances import JointCompliance
from elastocal.manipulator.effects.driven import (
    BaseMotion,
    DrivenEffect,
    Entry,
    JointMotion,
    LinkFrame,
    LinkLength,
    MarkerMotion,
)
from elastocal.manipulator.inputs import row_inputs
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import observe
from elastocal.manipulator.tape import Tape
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
EntryKey = tuple[str, tuple[str, ...]]

ENTRIES: tuple[Entry, ...] = (
    JointMotion(),
    LinkLength(),
    LinkFrame(),
    BaseMotion(),
    MarkerMotion(),
)
# The signal that a parameter without a known size is expected to make, rms over its rows.
UNSIZED_SIGNAL = 2e-4


@dataclass(frozen=True)
class Columns:
    """B of the model, of direct hypotheses and of the chain's entries, row by row of the table.

    `rows` (n_rows, size, K) at the fitted values, raw; `places` says which columns of it belong to
    an effect (or entry) at a place.  `whole` is the model with all of them, at x (K,).
    """

    base: Baseline
    rows: Array
    places: dict[tuple[str, str], slice]
    whole: Model
    x: Array

    @cached_property
    def table(self) -> Measurements:
        return self.base.seen.table

    def observed(self, rows: Array) -> Array:
        """Per table row (n_rows, size, k) → per observation (N, size, k)."""
        return self.base.seen.apply(rows)

    def of(self, hypothesis: Hypothesis) -> Array:
        """Columns (n_rows, size, k) of a hypothesis that is not driven."""
        return self.rows[:, :, self.places[hypothesis.name, hypothesis.where]]

    def from_each_start(self, hypothesis: Hypothesis) -> Iterator[Array]:
        """Its columns (n_rows, size, k) about each of the starts of which `of` has the best."""
        for tangent in tangents(self.whole, hypothesis, self.base, self.x, self.rows):
            yield tangent.columns

    def torques(self) -> Array:
        """The load's torque τ (n_rows, joints) on every joint, zero where nothing depends on it.

        δq = k τ, so ∂(reading)/∂k = ∂(reading)/∂q · τ.
        """
        n = self.base.model.chain.n_joints
        tau = np.zeros((len(self.rows), n))
        for i in range(n):
            span = self.places.get((JointCompliance.name, f"joint{i + 1}"))
            if span is None:
                continue
            by_k = self.rows[:, :, span].sum(axis=2)
            by_q = self.rows[:, :, self.places["joint_motion", f"joint{i + 1}"]][:, :, 0]
            squared = (by_q**2).sum(axis=1)
            along = (by_k * by_q).sum(axis=1)
            tau[:, i] = np.divide(along, squared, out=np.zeros(len(along)), where=squared > 1e-12)
        return tau

    def entry(self, key: EntryKey) -> Array:
        """∂(reading)/∂u (n_rows, size, d) of the entry's motions at its places, stacked."""
        name, places = key
        return np.concatenate([self.rows[:, :, self.places[name, w]] for w in places], axis=2)


def is_driven(hypothesis: Hypothesis) -> bool:
    return isinstance(hypothesis.effect, DrivenEffect)


def entry_key(hypothesis: Hypothesis, model: Model) -> EntryKey:
    """The entry that a driven hypothesis acts on."""
    effect = hypothesis.effect
    assert isinstance(effect, DrivenEffect)
    return effect.entry.name, effect.entered_at(hypothesis.where, model.chain)


def compute_columns(
    base: Baseline, hypotheses: list[Hypothesis], found: dict[str, float] | None = None
) -> Columns:
    """One evaluation of B of the fitted arm with every hypothesis and entry at zero.

    `found` are parameters of hypotheses that are not at zero, by name.

    Deflections enter by eq. (3), the load's torques at the undeflected pose: the columns differ
    from those of the equilibrium by the ratio of deflection to lever arm, a part in a thousand.
    """
    model, table = base.model, base.seen.table
    chain, cell = model.chain, model.cell
    direct = [h for h in hypotheses if not is_driven(h)]
    spec = replace(
        cell.model,
        effects=(*cell.model.effects, *(h.choice for h in direct)),
        observe="position" if cell.model.observe == "deflection" else cell.model.observe,
        deflection_model="linear",
    )
    extra = [(e, w) for e in ENTRIES for w in e.places(chain, cell)]
    key = "columns", spec.effects
    whole = made_once(model, key, lambda: Model.assembled(chain, replace(cell, model=spec), extra))
    at = dict(zip(model.names, base.x, strict=True)) | (found or {})
    x = np.array([at.get(p.name, p.nominal) for p in whole.parameters])
    seen = observe(table, whole.observe)
    B = whole.regressor(table, x, observations=seen).B.reshape(len(table), seen.size, -1)
    B = with_tangents(whole, direct, base, x, B)
    spans: dict[tuple[str, str], list[int]] = {}
    for k, p in enumerate(whole.parameters):
        spans.setdefault((p.effect, p.where), []).append(k)
    places = {key: slice(v[0], v[-1] + 1) for key, v in spans.items()}
    return Columns(base, B, places, whole, x)


def typical_sizes(hypothesis: Hypothesis, columns: Array) -> Array:
    """Prior standard deviation (k,) of each parameter: its typical size.

    Where none is known, the value whose signal in the columns (…, k) is UNSIZED_SIGNAL rms.
    """
    flat = columns.reshape(-1, columns.shape[-1])
    moved = flat[np.abs(flat).max(axis=1, initial=0.0) > 0]
    rms = np.sqrt((moved**2).mean(axis=0)) if len(moved) else np.zeros(flat.shape[1])
    signal = np.divide(UNSIZED_SIGNAL, rms, out=np.zeros(len(rms)), where=rms > 0)
    typical = [p.typical for p in hypothesis.parameters]
    return np.array([s if t is None else t for s, t in zip(signal, typical, strict=True)])


class Drive:
    """D(row, settings) = ∂u/∂p (d, k) of a driven hypothesis, from its CasADi expression."""

    def __init__(self, hypothesis: Hypothesis, model: Model) -> None:
        effect = hypothesis.effect
        assert isinstance(effect, DrivenEffect)
        self.hypothesis = hypothesis
        self._arm = Arm(model.chain, model.cell)
        fitted = {s.key: ca.SX.sym(s.key) for s in hypothesis.parameters}
        searched = {s.key: ca.SX.sym(s.key) for s in hypothesis.settings}
        u = effect.drive(self._arm, hypothesis.where, {**fitted, **searched})
        D = ca.jacobian(u, ca.vertcat(*fitted.values()))
        constants = ca.vertcat(ca.SX.zeros(0, 1), *searched.values())
        # Most drives ask for one or two numbers of a row: evaluated at thousands of settings, all
        # that the arm declared would be copied as many times.
        declared = ca.vertcat(*self._arm.inputs.values())
        used = [k for k in range(declared.numel()) if ca.depends_on(D, declared[k])]
        self._used = np.array(used, dtype=np.int64)
        asked = ca.vertcat(ca.SX.zeros(0, 1), *(declared[k] for k in used))
        self._tape = Tape([asked, constants], [D])

    def asked(self, table: Measurements) -> Array:
        """What D depends on in each row of the table (n_rows, quantities)."""
        return np.concatenate(row_inputs(self._arm, table), axis=1)[:, self._used]

    def __call__(self, table: Measurements, settings: Array) -> Array:
        """D (n_rows, G, d, k) at each of the `settings` (G, number of settings)."""
        G, n = len(settings), len(table)
        asked = np.repeat(self.asked(table), G, axis=0)
        D = self._tape(asked, np.tile(settings, (n, 1)))[0]
        return np.asarray(D.reshape(n, G, *D.shape[1:]))
