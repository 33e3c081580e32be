"""Parameters: what an effect brings into the model, with name, unit, nominal value and size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ParameterSpec:
    """A parameter as its effect declares it, before it has a place.

    `typical` is the size one expects of the deviation from nominal; columns of B
    are scaled by it before any rank is judged, so that metres and rad/(N m) compare.
    None means that no size is known beforehand (a compliance without a nominal value):
    `Model.sizes` then finds one from what moves the readings.
    """

    key: str
    unit: str
    nominal: float
    typical: float | None
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class Parameter:
    """A parameter of the model, at its place: `name` is "joint2.compliance"."""

    name: str
    effect: str
    where: str
    unit: str
    nominal: float
    typical: float | None
    lower: float = -np.inf
    upper: float = np.inf
