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
from elastocal.units import Array


def settling_joints(model: Model, record: VisitRecord) -> SharedEffect:
    """What the joints' own scatter of `[noise]` puts on each visit's readings, of variance one."""
    loading = record.motion * model.cell.noise.of_joints(model.chain.n_joints)
    return SharedEffect("joints", (VISIT,), record.visit, loading)


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
    effects: list[SharedEffect] = []
    if record is not None and noise.joints.any():
        effects.append(settling_joints(model, record))
    position = np.arange(size) < 3
    if noise.configuration and observed.kind in ("position", "pose"):
        off = np.diag(np.where(position, noise.configuration, 0.0))[:, position]
        unit = observed.configuration[:, None]
        loading = np.broadcast_to(off, (len(unit), 1, *off.shape))
        effects.append(SharedEffect("configuration", ("configuration",), unit, loading))
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
