"""The parameters as YAML or JSON, to be read by people and by programs of their own."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from elastocal.export.cost import Cost
from elastocal.export.pieces import Pieces
from elastocal.export.rigid_text import rpy
from elastocal.manipulator.calibrated import CalibratedArm
from elastocal.manipulator.chain import Array

SCHEMA = "elastocal/parameters/1"
KEYS = ("value", "unit", "std", "ci95", "identifiable", "combined_with", "nominal", "held", "note")


def estimates_of(calibrated: CalibratedArm) -> list[dict[str, Any]]:
    """Per parameter, in the model's order: name and what identify says of it.

    What an older result does not have is null.
    """
    return [
        {"name": name} | {key: _finite(entry.get(key)) for key in KEYS}
        for name, entry in zip(calibrated.model.names, calibrated.entries, strict=True)
    ]


def held_values(estimates: list[dict[str, Any]]) -> dict[str, float]:
    """Parameters that the data did not determine, with the values used for them (SI)."""
    return {e["name"]: e["held"] for e in estimates if e["identifiable"] is not True}


def parameter_document(
    calibrated: CalibratedArm, estimates: list[dict[str, Any]], pieces: Pieces, cost: Cost
) -> dict[str, Any]:
    """Everything to be written: estimates, the geometry they make, and that geometry's cost.

    Joint and flange placements are those of the calibrated URDF: in the frame before, in m and
    rad (roll, pitch, yaw), offsets included, so that joint values stay commanded ones.
    """
    chain = pieces.calibrated_chain()
    cell = calibrated.model.cell
    return {
        "schema": SCHEMA,
        "robot": chain.name,
        "cell": None if cell.path is None else Path(cell.path).name,
        "result": Path(calibrated.source).name,
        "units": "SI: m, rad, N, kg",
        "parameters": estimates,
        "geometry": {
            "tracker_to_base": _placed(pieces.T_tracker_base),
            "joints": [
                {"name": joint.name, "kind": joint.kind, **_placed(joint.placement),
                 "axis": [float(v) for v in joint.axis]}
                for joint in chain.joints
            ],
            "flange": _placed(chain.flange_placement),
            "markers": {name: _placed(T) for name, T in pieces.markers.items()},
            "load_point_m": [float(v) for v in pieces.load_point],
        },
        "geometry_alone": cost_json(cost),
    }  # fmt: skip


def cost_json(cost: Cost) -> dict[str, Any]:
    """A cost in µm, with what it was found under."""
    return {
        "poses": cost.poses,
        "poses_without_equilibrium": cost.unsettled,
        "force_N": [float(v) for v in cost.force],
        "total": cost.total.to_json(),
        "effects": [
            {"effect": e.effect, "note": e.note,
             "difference": None if e.difference is None else e.difference.to_json()}
            for e in cost.effects
        ],
    }  # fmt: skip


def _placed(T: Array) -> dict[str, list[float]]:
    return {
        "xyz_m": [float(v) + 0.0 for v in T[:3, 3]],
        "rpy_rad": [v + 0.0 for v in rpy(T[:3, :3])],
    }


def _finite(value: Any) -> Any:
    """NaN and infinity, which JSON does not have, as null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list):
        return [_finite(v) for v in value]
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    return value
