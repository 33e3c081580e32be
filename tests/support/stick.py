"""Arms simple enough to know the answer: straight sticks along x, everything at the base frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from support.cells import choices, table_of

from elastocal.cell import Cell
from elastocal.cell_tables import ModelSpec, Nominal, Robot, Tool, Tracker
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain, Joint, LinkMass
from elastocal.model.manipulator import Model
from elastocal.units import Array

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def shifted(x: float) -> Array:
    T = np.eye(4)
    T[0, 3] = x
    return T


def stick(axes: str = "y", lengths: Sequence[float] = (1.0,), mass: float = 0.0) -> Chain:
    """One link of `lengths` per joint about one of `axes`; a `mass` in the middle of each link."""
    before = [0.0, *lengths[:-1]]
    return Chain(
        "stick",
        tuple(
            Joint(f"q{i + 1}", "revolute", shifted(x), np.array(AXES[axis]))
            for i, (axis, x) in enumerate(zip(axes, before, strict=True))
        ),
        shifted(lengths[-1]),
        tuple(LinkMass(mass, np.array([x / 2, 0.0, 0.0])) for x in lengths) if mass else (),
    )


def model(
    chain: Chain,
    *effects: str,
    tip: Sequence[float] = (0.0, 0.0, 0.0),
    settings: dict[str, dict[str, float]] | None = None,
    tracker: Sequence[float] = (0.0, 0.0, 0.0),
    **spec: Any,
) -> Model:
    """The only marker and the load point are at `tip` in the flange frame."""
    point = np.array(tip, dtype=float)
    spec.setdefault("nominal", Nominal(settings=settings or {}))
    return Model.assembled(
        chain,
        Cell(
            "stick",
            None,
            Robot(),
            Tool(point, {"tip": point}),
            Tracker(np.array(tracker, dtype=float)),
            ModelSpec(effects=choices(effects), **spec),
        ),
    )


def rows(q: Any, force: Sequence[float] = (0.0, 0.0, 0.0), **columns: Any) -> Measurements:
    """One row per pose in `q` (n, joints), or (n,) for one joint, with further columns."""
    q = np.asarray(q, dtype=float)
    q = q[:, None] if q.ndim == 1 else q
    table = table_of(q, np.array(force, dtype=float), ("tip",))
    return replace(table, **{name: np.asarray(v, dtype=float) for name, v in columns.items()})


def positions(m: Model, table: Measurements, **values: float) -> Array:
    """Predicted positions (n, 3) with parameters named by their key, the rest nominal."""
    x = m.nominal
    for key, value in values.items():
        at = [k for k, name in enumerate(m.names) if name.split(".")[-1] == key]
        assert at, f"no parameter {key} in {m.names}"
        x[at] = value
    return m.predict(table, x).reshape(-1, 3)
