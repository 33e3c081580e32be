"""The residuals of an identification or a diagnosis as arrows on the posed arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations
from elastocal.report.space import Posed, Space, frames_at, space_of
from elastocal.report.units import length
from elastocal.report.words import printable

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_POSES = 80  # in the page; of more, those with the largest residuals and a random choice
WORST = 30


def residual_space(model: Model, seen: Observations, x: Array, residual: Array) -> Space:
    """One pose per configuration and load, its arrows the mean residual of each marker.

    `residual` (rows,) is observed minus predicted at parameter values x (parameters,); of a pose
    the position counts, a distance's residual lies along the line from its anchor.
    """
    table = seen.table
    force = np.round(table.force[seen.lead], 3)
    key = np.column_stack([seen.configuration, force])
    _, first, entry = np.unique(key, axis=0, return_index=True, return_inverse=True)
    entry = entry.ravel()
    vectors = residual_vectors(model, seen, x, residual)
    rms = np.sqrt(np.bincount(entry, (vectors**2).sum(axis=1)) / np.bincount(entry))
    chosen = _chosen(rms, np.argsort(first))
    rows = seen.lead[first[chosen]]
    frames, flange = frames_at(
        model.cell, model.chain, table.q[rows], model.flange_poses(table.take(rows), x)
    )
    at = marker_positions(model, seen, x)
    several = len(np.unique(force, axis=0)) > 1
    poses = []
    for k, code in enumerate(chosen):
        own = np.flatnonzero(entry == code)
        markers = np.unique(table.marker[seen.lead[own]])
        groups = [own[table.marker[seen.lead[own]] == m] for m in markers]
        name = table.configuration_labels[table.configuration[rows[k]]]
        poses.append(
            Posed(
                name=f"{name}, {_load(table.force[rows[k]])}" if several else name,
                about=f"rms residual {length(float(rms[code]))} of {len(own)} readings",
                frames=frames[k],
                flange=flange[k],
                markers=np.array([at[g].mean(axis=0) for g in groups]),
                names=tuple(table.marker_names[m] for m in markers),
                arrows=np.array([vectors[g].mean(axis=0) for g in groups]),
            )
        )
    return space_of(model.cell, model.chain, poses, int(np.argmax(rms[chosen])), "configuration")


def view_caption(space: Space, configurations: int) -> str:
    """What the arrows are, and how much they are enlarged in the still picture."""
    text = (
        f"Mean residual of each marker as an arrow, {space.scale:g} times as long as it is, in "
        f"configuration {printable(space.poses[space.first].name)}, which has the largest, and in "
        f"all of them. The arm is drawn as {space.shells.drawn_from}."
    )
    if len(space.poses) < configurations:
        text += (
            f" {len(space.poses)} poses of {configurations} configurations: those with the "
            "largest residuals, and a random choice."
        )
    return text


def time_caption(seen: Observations) -> str:
    """What the figure over time shows, and what it would mean."""
    text = (
        "{}; lines are means with twice their standard error. A slope is a drift, a step something "
        "that moved."
    )
    if seen.table.time is None:
        return text.format("In the order of the table, which has no column time_s or time_min")
    return text.format("Over time")


def _chosen(rms: Array, order: IntArray) -> IntArray:
    """The entries to show, in the table's order."""
    if len(rms) <= MOST_POSES:
        return order
    worst = np.argsort(-rms)[:WORST]
    rest = np.setdiff1d(order, worst)
    drawn = np.random.default_rng(0).choice(rest, MOST_POSES - WORST, replace=False)
    return order[np.isin(order, np.concatenate([worst, drawn]))]


def residual_vectors(model: Model, seen: Observations, x: Array, residual: Array) -> Array:
    """Residuals (N, 3) in m as vectors in the data's frame."""
    parts = residual.reshape(-1, seen.size)
    if seen.kind != "distance":
        return np.asarray(parts[:, :3])
    anchor = model.cell.tracker.anchor
    line = marker_positions(model, seen, x) - (np.zeros(3) if anchor is None else anchor)
    return np.asarray(parts * line / np.linalg.norm(line, axis=1, keepdims=True))


def marker_positions(model: Model, seen: Observations, x: Array) -> Array:
    """Where the markers (N, 3) were seen, or where the model puts them if only a distance was."""
    table = seen.table
    if table.position is not None:
        return np.asarray(table.position[seen.lead])
    return model.target_poses(table, x)[1][seen.lead]


def _load(force: Array) -> str:
    if not force.any():
        return "unloaded"
    return "(" + ", ".join(f"{f + 0.0:.6g}" for f in force) + ") N"
