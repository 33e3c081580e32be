"""Strict JSON of everything that is written: RFC 8259 knows neither NaN nor infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """`value` with numpy numbers and arrays as plain ones, and None for numbers not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    # numpy's arrays and numbers, without loading numpy for it: --help comes by here.
    return plain(value.tolist()) if hasattr(value, "tolist") else value


def json_text(value: Any) -> str:
    """`value` as strict JSON over several lines, without a newline at its end.

    Numbers that do not exist become null; documentation of each key says what its null means.
    Raises TypeError for what JSON has no form for.
    """
    return json.dumps(plain(value), indent=1, allow_nan=False)
