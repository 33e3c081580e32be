"""A whole arm after its diagnosis: errors at new poses beside the oracle's, shares and names."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from draw import World
from whole_oracle import Sights, gap_of, oracle_error
from whole_score import Scored, score_parts

NEW, RESULT = "new.csv", "result.json"
# Runs `elastocal ARGUMENTS` in the visible folder; its exit code.
Command = Callable[..., int]


def judged(
    world: World,
    visible: Path,
    fresh: Path,
    command: Command,
    answer: Mapping[str, Any] | None,
    extended: str,
) -> dict[str, Any]:
    """What the campaign's answer is worth; the new poses are shown to the tool only now.

    Rms lengths in mm of the errors at new poses: geometry_mm of the cell as it is, tool_mm of the
    `extended` one, both as `identify --test` has them, None where it fails; oracle_mm; gap_um: rms
    of a coordinate of what geometry leaves of the effects; parts: its shares, strengths: mean
    squares of each over that of all; and `Scored`.
    """
    sights = Sights.of(world)
    shutil.copyfile(fresh, visible / NEW)
    gap = gap_of(sights)
    found = Scored((), (), ()) if answer is None else score_parts(gap, answer)
    return {
        "geometry_mm": _tested(visible, command, "cell.toml"),
        "tool_mm": None if answer is None else _tested(visible, command, extended),
        "oracle_mm": 1e3 * oracle_error(sights),
        "gap_um": 1e6 * gap.rms,
        "parts": {":".join(part): gap.share([part]) for part in gap.parts},
        "strengths": {":".join(part): gap.strength([part]) for part in gap.parts},
        "shares": [asdict(s) | {"held": s.held} for s in found.shares],
        "names": [asdict(n) | {"right": n.right} for n in found.names],
        "missed": list(found.missed),
    }


def over_oracle(whole: Mapping[str, Any], key: str = "tool_mm") -> float:
    """The tool's error, or that of geometry, over the oracle's; infinite where there is none."""
    return np.inf if whole[key] is None else float(whole[key] / whole["oracle_mm"])


def _tested(visible: Path, command: Command, cell: str) -> float | None:
    if command("identify", cell, "data.csv", "--test", NEW, "-o", RESULT) != 0:
        return None
    result = json.loads((visible / RESULT).read_text(encoding="utf-8"))
    return float(result["test"]["rms_um"]) / 1e3
