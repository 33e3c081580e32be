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
from elastocal.identification.reduction import Reduction
from elastocal.manipulator.effects import CATALOGUE
from elastocal.manipulator.effects.placements import MarkerPosition
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Share of a test point's motion that may lie outside what the poses show: rounding, not physics.
OUTSIDE = 1e-6


def prediction_rows(information: PoseInformation, targets: TargetPoses, x: Array) -> Array:
    """A (T, r, parameters): ∂(position at the test pose)/∂X in m per unit, at arm values x.

    The position is that under load in the data's frame; base and markers move it too, so that it
    does not depend on how the arm's frames are chosen.  It is that of the test point.  Where the
    markers' own places are fitted and no point was stated, it is that of the M markers, each
    divided by √M, as only they can be known: the sum of squares is then their mean.
    """
    model = information.model
    fitted = any(p.effect == MarkerPosition.name for p in model.parameters)
    by_marker = ~targets.stated & fitted
    markers = tuple(model.cell.tool.markers)
    M = len(markers) if by_marker.any() else 1
    A = np.zeros((len(targets.q), M, 3, len(model.parameters)))
    if by_marker.any():
        own = replace(model.cell.model, observe="position")
        arm = Model.assembled(model.chain, replace(model.cell, model=own))
        which = np.flatnonzero(by_marker)
        code = np.tile(np.arange(M), len(which))
        table = _table(targets, np.repeat(which, M), code, markers)
        A[which] = arm.regressor(table, x).B.reshape(len(which), M, 3, -1) / np.sqrt(M)
    if not by_marker.all():
        which = np.flatnonzero(~by_marker)
        points, code = np.unique(targets.point[which], axis=0, return_inverse=True)
        names = tuple(f"test point {k + 1}" for k in range(len(points)))
        arm = _with_points(model, dict(zip(names, points, strict=True)))
        table = _table(targets, which, code.ravel(), names)
        A[which, 0] = arm.regressor(table, x).B.reshape(len(which), 3, -1)
    return A.reshape(len(A), 3 * M, -1)


def _table(
    targets: TargetPoses, pose: IntArray, marker: IntArray, names: tuple[str, ...]
) -> Measurements:
    """The test poses `pose` (R,) as rows with these markers."""
    n = len(pose)
    return Measurements(
        source="test poses",
        row=pose + 1,
        q=targets.q[pose],
        configuration=pose,
        configuration_labels=tuple(map(str, range(1, len(targets.q) + 1))),
        repeat=np.zeros(n, dtype=np.int64),
        marker=marker,
        marker_names=names,
        force=targets.force[pose],
        position=np.zeros((n, 3)),
    )


def _with_points(model: Model, points: dict[str, Array]) -> Model:
    """The same arm with the test points as markers whose place on the flange is known."""
    cell = model.cell
    effects = tuple(
        EffectChoice(choice.name, place)
        for choice in cell.model.effects
        for place in _places(choice, model)
    )
    spec = replace(cell.model, effects=effects, observe="position")
    tool = replace(cell.tool, markers=cell.tool.markers | points)
    return Model.assembled(model.chain, replace(cell, model=spec, tool=tool))


def _places(choice: EffectChoice, model: Model) -> tuple[str, ...]:
    """Where the effect acts on the model as it is, without the test points."""
    if choice.where is not None:
        return (choice.where,)
    return CATALOGUE[choice.name].places(model.chain, model.cell)


def on_kept(model: Model, A: Array, found: Estimable) -> Array:
    """A (S, T, r, kept) on the kept parameters, scaled by their sizes, under S scenarios.

    A test point is predictable where its motion by the dropped parameters is that by the kept
    ones they combine with: A_D = A_K · mixing.  Raises InsufficientDataError that names the
    parameter where it is not: no number of poses would make that position certain.
    """
    lost = unpredictable(A[0], found)  # the mixing is that of the first scenario
    if lost is not None:
        pose, index = lost
        raise InsufficientDataError(
            f"{model.cell.path or model.cell.name}: the position at test pose {pose + 1} depends "
            f"on {model.names[index]}; {why(model, found, index)}; or ask for parameters instead "
            'of test poses (criterion = "D")'
        )
    kept = found.reduction.kept
    return np.asarray(A[..., kept] * found.sizes[kept])


def unpredictable(A: Array, found: Estimable) -> tuple[int, int] | None:
    """A row of A (T, r, parameters) and a parameter by which no plan can predict it, if any."""
    r, sizes = found.structure, found.sizes
    off = np.abs(_unexplained(A, r, sizes)).max(axis=1)
    if off.max(initial=0.0) <= OUTSIDE * float(np.abs(A * sizes).max()):
        return None
    dropped = int(off.max(axis=0).argmax())
    return int(off[:, dropped].argmax()), int(r.dropped[dropped])


def remaining_bias(A: Array, weight: Array, found: Estimable) -> float:
    """Rms in m of what typical deviations of held parameters move the test points by.

    A (T, r, parameters), `weight` (T,): held are those that the poses show below their noise.
    """
    off = _unexplained(A, found.reduction, found.sizes)
    return float(np.sqrt(weight @ (off**2).sum(axis=(1, 2))))


def _unexplained(A: Array, r: Reduction, sizes: Array) -> Array:
    """(T, r, dropped): A_D − A_K · mixing, times the sizes."""
    return np.asarray((A[..., r.dropped] - A[..., r.kept] @ r.mixing) * sizes[r.dropped])
