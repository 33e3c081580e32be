"""The criterion a user names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from elastocal.design.criteria.base import Array, Criterion, IntArray
from elastocal.design.criteria.combination_variance import combination_variance
from elastocal.design.criteria.determinant import DeterminantCriterion
from elastocal.design.criteria.eigenvalue import EigenvalueCriterion
from elastocal.design.criteria.marginal import Interest
from elastocal.design.criteria.o1 import FirstObservability
from elastocal.design.criteria.o2 import SecondObservability
from elastocal.design.criteria.o3 import ThirdObservability
from elastocal.design.criteria.o4 import FourthObservability
from elastocal.design.criteria.o5 import FifthObservability
from elastocal.design.criteria.parameter_variance import parameter_variance
from elastocal.design.criteria.prediction_maximum import GCriterion
from elastocal.design.criteria.prediction_variance import prediction_variance
from elastocal.design.criteria.remaining_error import remaining_error
from elastocal.design.criteria.scenarios import ScenarioCriterion
from elastocal.design.criteria.worst import Worst
from elastocal.errors import InputError, require
from elastocal.text import did_you_mean, listed, quoted

Robust = Literal["none", "average", "worst"]


@dataclass(frozen=True)
class _Request:
    parameters: int
    interest: IntArray
    scenarios: int
    A: Array | None
    weights: Array | None
    combination: Array | None
    unit: str
    n_poses: int | None


def make_criterion(
    name: str,
    *,
    parameters: int,
    interest: IntArray,
    scenarios: int = 1,
    A: Array | None = None,
    weights: Array | None = None,
    combination: Array | None = None,
    unit: str = "",
    n_poses: int | None = None,
    robust: Robust = "none",
) -> Criterion:
    """The criterion `name`, one of CRITERIA, for p = `parameters` scaled parameters.

    `interest` (k,): indices that A, D, E and O1 to O5 count; the other parameters are
    marginalised.  A (S, T, r, p) = ∂(position at target t)/∂X for test_pose, I and G, the first
    with `weights` (T,), equal by default; `combination` (p,) and its `unit` for c; `n_poses` for
    O1.  Over S = `scenarios` > 1 of the arm, `robust` says whether the average or the worst
    counts.
    Raises InputError for an unknown name, and where something the criterion needs is missing, of
    another shape, or empty.
    """
    require(
        name in _MAKERS,
        f"criterion {quoted(name)} is unknown{did_you_mean(name, CRITERIA)}; there are "
        f"{listed(CRITERIA)}",
    )
    require(
        robust in ("none", "average", "worst"),
        f"robust = {quoted(robust)} is unknown{did_you_mean(robust, ('none', 'average', 'worst'))}"
        "; there are none, average, worst",
    )
    require(
        robust != "none" or scenarios == 1,
        f"criterion {name} has {scenarios} scenarios of the arm to weigh: say whether the "
        'average or the worst counts (robust = "average" or "worst")',
    )
    chosen = np.asarray(interest, dtype=np.int64)
    request = _Request(parameters, chosen, scenarios, A, weights, combination, unit, n_poses)
    criterion = _MAKERS[name](request)
    return Worst(criterion) if robust == "worst" else criterion


def _known_interest(request: _Request) -> IntArray:
    return Interest(request.interest).ordered(request.parameters)[-len(request.interest) :]


def _targets(request: _Request, name: str) -> Array:
    shape = (request.scenarios, None, None, request.parameters)
    return _given(request.A, name, "test poses", shape)


def _test_pose(request: _Request) -> ScenarioCriterion:
    A = _targets(request, "test_pose")
    if request.weights is None:
        return remaining_error(A, np.ones(A.shape[1]))
    weights = _given(request.weights, "test_pose", "weights of the test poses", A.shape[1:2])
    require(
        bool((weights >= 0).all() and weights.any()),
        f"weights of the test poses are {quoted(weights.tolist())}: none may be negative, and one "
        "at least must be positive",
    )
    return remaining_error(A, weights)


def _combination(request: _Request) -> ScenarioCriterion:
    c = _given(request.combination, "c", "a parameter or combination", (request.parameters,))
    return combination_variance(c, request.scenarios, request.unit)


def _o1(request: _Request) -> ScenarioCriterion:
    n = request.n_poses
    if n is None:
        raise InputError("criterion O1 needs the number of poses: set [design] poses")
    return FirstObservability(_known_interest(request), n)


def _parameter_variance(request: _Request) -> ScenarioCriterion:
    return parameter_variance(_known_interest(request), request.parameters, request.scenarios)


def _given(array: Array | None, name: str, what: str, shape: tuple[int | None, ...]) -> Array:
    """`array` where it is there, of this shape (None: any positive length) and finite."""
    if array is None:
        raise InputError(f"criterion {name} needs {what}: add to [design], or choose another")
    found = np.asarray(array, dtype=float)
    fits = found.ndim == len(shape) and all(
        n > 0 if wanted is None else n == wanted
        for n, wanted in zip(found.shape, shape, strict=True)
    )
    wanted = ", ".join("n" if length is None else str(length) for length in shape)
    require(fits, f"criterion {name}: an array of shape {found.shape} was given, not ({wanted})")
    require(
        bool(np.isfinite(found).all()),
        f"criterion {name}: {what} with derivatives that are not finite; check that every test "
        "pose is within reach and has a static equilibrium",
    )
    return found


_MAKERS: dict[str, Callable[[_Request], ScenarioCriterion]] = {
    "test_pose": _test_pose,
    "A": _parameter_variance,
    "D": lambda request: DeterminantCriterion(_known_interest(request)),
    "E": lambda request: EigenvalueCriterion(_known_interest(request)),
    "G": lambda request: GCriterion(_targets(request, "G")),
    "I": lambda request: prediction_variance(_targets(request, "I")),
    "c": _combination,
    "O1": _o1,
    "O2": lambda request: SecondObservability(_known_interest(request)),
    "O3": lambda request: ThirdObservability(_known_interest(request)),
    "O4": lambda request: FourthObservability(_known_interest(request)),
    "O5": lambda request: FifthObservability(_known_interest(request)),
}
CRITERIA = tuple(_MAKERS)
