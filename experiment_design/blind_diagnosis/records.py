"""The record of a world, and what of the answer it keeps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Record = dict[str, Any]
CANDIDATES = 10
KEPT = (
    "verdict", "p_value", "probability_nothing", "probability_unknown", "gap", "effects",
    "indistinguishable", "location", "noise", "extra_plan", "warnings",
)  # fmt: skip


def shortened(diagnosis: Mapping[str, Any]) -> Record:
    """The part of a diagnosis that is kept: without curves, tests and hopeless candidates."""
    kept = {key: diagnosis[key] for key in KEPT}
    kept["components"] = diagnosis.get("components")
    kept["candidates"] = diagnosis["candidates"][:CANDIDATES]
    return kept
