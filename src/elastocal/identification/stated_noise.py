"""All of the noise that a cell states: of single readings, and what [noise] says they share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from elastocal.identification.noise_structure import (
    VISIT,
    SharedEffect,
    VisitRecord,
    along_axes,
    faster_course,
    visit_record,
)
from elastocal.identification.weighted_problem import Weights, whitener
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, IntArray


def settled(model: Model, record: VisitRecord | None) -> list[SharedEffect]:
    """What the joints' own scatter of `[noise]` puts on each visit's readings, of variance one."""
    noise = model.cell.noise
    if record is None or not noise.joints.any():
        return []
    loading = record.motion * noise.of_joints(model.chain.n_joints)
    return [SharedEffect("joints", (VISIT,), record.visit, loading)]


def configured(model: Model, observed: Observations) -> list[SharedEffect]:
    """What `[noise]` says that configurations are off by as a whole, likewise."""
    off = model.cell.noise.configuration
    if not off or observed.kind not in ("position", "pose"):
        return []
    return [moved_together("configuration", observed, observed.configuration, off)]


def moved_together(name: str, observed: Observations, unit: IntArray, off: float) -> SharedEffect:
    """A deviation of `off` m in each direction common to the positions of each `unit` (N,)."""
    axes = np.eye(observed.size)[:, : min(observed.size, 3)] * off
    loading = np.broadcast_to(axes, (len(unit), 1, *axes.shape))
    return SharedEffect(name, (name,), unit[:, None], loading)


def stated_lasting(model: Model, record: VisitRecord) -> float:
    """The stated correlation time as a share of the campaign; without times a visit takes as long
    as the arm stands still, as in a simulation."""
    span = record.span * (1.0 if record.timed else model.cell.design.motion.dwell)
    return model.cell.noise.lasting / span


def with_stated_sharing(own: Weights, model: Model, observed: Observations, x: Array) -> Weights:
    """The weights `own` of single readings with what `[noise]` of the cell says that they share.

    Σ = Σ_own + Z Zᵀ as a simulation draws it: joints that settle anew at each visit, configurations
    that are off as a whole, and a drift.
    """
    noise, size = model.cell.noise, observed.size
    if not noise.shared or own.whiten is None or not own.absolute:
        return own
    record = visit_record(model, observed, x)
    effects = [*settled(model, record), *configured(model, observed)]
    position = np.arange(size) < 3
    waves = None
    if record is not None and noise.drift and size > 1:
        along, lasting = np.where(position, noise.drift, 0.0), stated_lasting(model, record)
        effects.append(faster_course(record, lasting, along))
        waves = along_axes(record.waves(lasting), along).reshape(len(observed.value), -1)
    if effects:
        Z = own.whiten @ sparse.hstack([effect.columns() for effect in effects], format="csr")
        beside = whitener(sparse.csr_array(sparse.eye_array(Z.shape[0]) + Z @ Z.T))
        own = replace(own, whiten=sparse.csr_array(beside @ own.whiten))
    return own if waves is None else own.with_common(waves, observed.configuration)
