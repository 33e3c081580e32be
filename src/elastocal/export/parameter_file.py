"""The parameters as YAML or JSON, to be read by people and by programs of their own."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from elastocal.export.exportable import Cost, ExportNumbers, rpy
from elastocal.model.calibrated import CalibratedArm
from elastocal.units import Array

# YAML of plain data: mappings, sequences, texts, numbers.  Reading YAML would need a library;
# writing this much of it does not.


def to_yaml(data: Any) -> str:
    """`data` (dicts with text keys, lists, texts, numbers, booleans, None) as YAML 1.1 and 1.2.

    Lists of plain values stand on one line; texts are quoted wherever YAML might take them for
    something else.
    """
    return "\n".join(_lines(data)) + "\n"


def _lines(data: Any) -> list[str]:
    if isinstance(data, dict) and data:
        lines = []
        for key, value in data.items():
            if _is_flow(value):
                lines.append(f"{_scalar(key)}: {_flow(value)}")
            else:
                lines += [f"{_scalar(key)}:", *(f"  {line}" for line in _lines(value))]
        return lines
    if isinstance(data, list) and not _is_flow(data):
        lines = []
        for item in data:
            first, *rest = _lines(item)
            lines += [f"- {first}", *(f"  {line}" for line in rest)]
        return lines
    return [_flow(data)]


def _is_flow(data: Any) -> bool:
    if isinstance(data, dict):
        return not data
    return not isinstance(data, list) or not any(isinstance(v, dict | list) for v in data)


def _flow(data: Any) -> str:
    if isinstance(data, list):
        return f"[{', '.join(_scalar(v) for v in data)}]"
    return "{}" if isinstance(data, dict) else _scalar(data)


def _scalar(value: Any) -> str:
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 takes 1e-07 for a text: a number needs a point before the exponent.
        mantissa, e, exponent = text.partition("e")
        return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"
    if isinstance(value, str) and _is_plain(value):
        return value
    # A JSON text, number or null is one in YAML too, except that YAML knows no surrogate pairs
    # and wants more characters escaped.
    text = json.dumps(value, allow_nan=False, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)


def _is_plain(text: str) -> bool:
    """Letters first, then letters, digits, and _ . : - / inside: no YAML reads it otherwise."""
    if not text.isascii() or text.lower() in {
        "true", "false", "yes", "no", "on", "off", "null", "y", "n", "nan", "inf",
    }:  # fmt: skip
        return False
    rest = text.translate(str.maketrans("", "", "_./-"))
    return text[:1].isalpha() and rest.isalnum()


# The parameters as YAML or JSON, to be read by people and by programs of their own.

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
    calibrated: CalibratedArm, estimates: list[dict[str, Any]], pieces: ExportNumbers, cost: Cost
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
