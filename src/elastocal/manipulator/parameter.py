"""Parameters: what an effect brings into the model, with name, unit, nominal value and size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
class Setting:
    """A constant inside an effect's expression that is set, not fitted: an order, a time.

    The amplitude of the effect vanishes at nominal, and with it every derivative with respect to
    such a constant, so a fit cannot find it; a search over `lower` to `upper` can.  The value
    comes from `[model.nominal.settings.PLACE]`, else `default`; None: there is none, and the
    model asks for it.  `key` carries the unit, as table columns do ("jump_time_s").

    `kind` says which values a diagnosis tries: "order" periods in one turn of the joint,
    "change_time" moments between two visits, "time_constant" some that the campaign can tell
    apart, "range" values at equal distances from `lower` to `upper`, which are finite then.
    """

    key: str
    kind: Literal["order", "change_time", "time_constant", "range"]
    default: float | None
    lower: float
    upper: float


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
