"""Where position must be right: A_t, how the parameters move the tool at the test poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import EffectChoice
from elastocal.design.information import PoseInformation
from elastocal.design.parameters import Estimable, why
from elastocal.design.target_poses import TargetPoses
from elastocal.errors import InsufficientDataError
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

# Share of a test point's motion that may lie outside what the poses show: rounding, not physics.
OUTSIDE = 1e-6


def prediction_rows(information: PoseInformation, targets: TargetPoses, x: Array) -> Array:
    """A (T, 3, parameters): ∂(position of the test point)/∂X at the test poses, in m per unit.

    The position is that under load in the data's frame, at arm values x; base and markers move it
    too, so that it does not depend on how the arm's frames are chosen.
    """
    points, which = np.unique(targets.point, axis=0, return_inverse=True)
    names = tuple(f"test point {k + 1}" for k in range(len(points)))
    model = _with_points(information.model, dict(zip(names, points, strict=True)))
    T = len(targets.q)
    table = Measurements(
        source="test poses",
        row=np.arange(1, T + 1),
        q=targets.q,
        configuration=np.arange(T),
        configuration_labels=tuple(map(str, range(1, T + 1))),
        repeat=np.zeros(T, dtype=np.int64),
        marker=which.ravel(),
        marker_names=names,
        force=targets.force,
        position=np.zeros((T, 3)),
    )
    return model.regressor(table, x).B.reshape(T, 3, -1)


def _with_points(model: Model, points: dict[str, Array]) -> Model:
    """The same arm with the test points as markers whose place on the flange is known."""
    cell = model.cell
    effects = tuple(
        EffectChoice(choice.name, place)
        for choice in cell.model.effects
        for place in _places(choice, cell.tool.markers)
    )
    spec = replace(cell.model, effects=effects, observe="position")
    tool = replace(cell.tool, markers=cell.tool.markers | points)
    return Model(model.chain, replace(cell, model=spec, tool=tool))


def _places(choice: EffectChoice, markers: dict[str, Array]) -> tuple[str | None, ...]:
    if choice.where is None and choice.name in ("marker_position", "marker_orientation"):
        return tuple(f"marker:{name}" for name in markers)
    return (choice.where,)


def on_kept(model: Model, A: Array, found: Estimable) -> Array:
    """A (T, 3, kept) on the kept parameters, scaled by their sizes.

    A test point is predictable where its motion by the dropped parameters is that by the kept
    ones they combine with: A_D = A_K · mixing.  Raises InsufficientDataError that names the
    parameter where it is not: no number of poses would make that position certain.
    """
    r, sizes = found.reduction, found.sizes
    kept = A[..., r.kept] * sizes[r.kept]
    largest = float(np.abs(A * sizes).max())
    off = np.abs((A[..., r.dropped] - A[..., r.kept] @ r.mixing) * sizes[r.dropped])
    worst = off.max(axis=(0, 1), initial=0.0)
    if len(worst) and worst.max() > OUTSIDE * largest:
        index = int(r.dropped[int(worst.argmax())])
        pose = int(off[..., int(worst.argmax())].max(axis=1).argmax()) + 1
        raise InsufficientDataError(
            f"{model.cell.path or model.cell.name}: the position at test pose {pose} depends on "
            f"{model.names[index]}; {why(model, found, index)}"
        )
    return kept
