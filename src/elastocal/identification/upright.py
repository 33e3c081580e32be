"""Which way is down: whether the arm stands in the readings' frame as the cell says it does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell.work_cell import Cell
from elastocal.measurements import Measurements
from elastocal.model.effects.placements import BaseFrame
from elastocal.model.manipulator import Model
from elastocal.units import Array

# Floors, pedestals and trackers are levelled to a degree; what is farther off is another frame.
FALLEN = np.radians(20.0)
AXES = ("x", "y", "z")


def as_placed(model: Model, x: Array) -> Cell:
    """The model's cell with the base turned as it is at x (parameters,)."""
    vector = [v for p, v in zip(model.parameters, x, strict=True)
              if p.effect == BaseFrame.name and p.unit == "rad"]  # fmt: skip
    if len(vector) != 3:
        return model.cell
    turned = Rotation.from_rotvec(vector).as_matrix()
    nominal = replace(model.cell.model.nominal, base_rotation=turned)
    return replace(model.cell, model=replace(model.cell.model, nominal=nominal))


@dataclass(frozen=True)
class Fallen:
    """An arm whose base lies `angle` rad from how the cell mounts it; `up` (3,) is the direction
    in the readings' frame that is up where it stands as the cell says."""

    angle: float
    up: Array

    @property
    def axis(self) -> str | None:
        """The axis that points up, "−y" say; None where none does within FALLEN."""
        k = int(np.argmax(np.abs(self.up)))
        if np.arccos(min(abs(self.up[k]), 1.0)) > FALLEN:
            return None
        return ("−" if self.up[k] < 0 else "") + AXES[k]

    @property
    def turn(self) -> Array:
        """R (3, 3) from the readings' frame to one whose z is that axis."""
        k = int(np.argmax(np.abs(self.up)))
        axis = np.sign(self.up[k]) * np.eye(3)[k]
        if axis[2] < 0:  # half a turn about x
            return np.diag([1.0, -1.0, -1.0])
        across = np.eye(3)[(k + 1) % 3] if k < 2 else np.eye(3)[0]
        return np.round(np.stack([across, np.cross(axis, across), axis]))

    def turned(self, table: Measurements) -> Measurements:
        """The table in that frame; forces stay, which are down by the cell's own word."""
        R = self.turn
        position = None if table.position is None else table.position @ R.T
        rotation = table.rotation
        if rotation is not None:
            rotation = (Rotation.from_matrix(R) * Rotation.from_rotvec(rotation)).as_rotvec()
        sigma = table.sigma
        if sigma is not None and table.sigma_frame == "cartesian":
            sigma = sigma @ np.abs(R).T
        return replace(table, position=position, rotation=rotation, sigma=sigma)

    @property
    def columns(self) -> str:
        """What the table's x, y, z would have to be: "x, −z, y"."""
        rows = [(int(np.argmax(np.abs(row))), row.sum() < 0) for row in self.turn]
        return ", ".join(("−" if minus else "") + AXES[k] for k, minus in rows)

    def __str__(self) -> str:
        text = (
            f"the fitted base lies {np.degrees(self.angle):.0f}° from how the cell mounts it, and "
            "weights and loads act along −z of the readings' frame"
        )
        if self.axis is None:
            return f"{text}. State how the arm is mounted, [model.nominal] base_rpy_deg"
        return (
            f"{text}. If it is mounted as stated, {self.axis} of that frame points up: write the "
            f"columns {self.columns} as x, y, z; else state [model.nominal] base_rpy_deg"
        )


def fallen(model: Model, x: Array) -> Fallen | None:
    """The arm at x (parameters,), where its base lies far from upright; None where it does not, or
    no base was fitted."""
    placed = as_placed(model, x)
    if placed is model.cell:
        return None
    stated, found = (c.model.nominal.base_rotation for c in (model.cell, placed))
    mounted = np.eye(3) if stated is None else np.asarray(stated)
    up = np.asarray(found) @ mounted.T[:, 2]
    angle = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    return Fallen(angle, up) if angle > FALLEN else None
