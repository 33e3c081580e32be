"""A whole arm after its diagnosis: errors at new poses beside the oracle's, shares and names.

The diagnosis lists `components`, each a family of errors at a place with its share of the gap
(of the squared gap: what goes when it is added last) and 90 % interval.  Families
that act by the same load, and the error against a joint's angle under any name, are one *kind*
here; a place without a number stands for all places of its kind.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from draw import World
from whole_oracle import Gap, Sights, gap_of, oracle_error
from worker import run

Json = Mapping[str, Any]
Part = tuple[str, str]

NEW, RESULT = "new.csv", "result.json"
SMALL = 0.01  # of the gap, in mean squares: what is less need not be found
ABSENT_BELOW = 1e-4  # a hundredth of the gap's rms: what is less is as good as absent
LIKELY = 0.5
KIND = {"torque": "load", "gravity": "load"}
# Effects of the catalogue that whole arms have, and what they are errors against; all others that
# FAMILY and ABSENT do not list are judged by their place alone.
FAMILY = {
    "gear_eccentricity": "angle", "gear_ripple": "angle", "link_mass_error": "load",
    "hysteresis": "move", "backlash": "move", "base_drift": "time", "joint_drift": "time",
    "gear_spectrum": "angle", "gravity_sag": "load", "move_lag": "move",
    "move_hysteresis": "move",
    "link_weights": "load",
}  # fmt: skip
ABSENT = (
    "encoder_scale", "gear_second_harmonic", "wrist_coupling", "joint_hardening",
    "off_axis_compliance", "link_bending", "base_compliance", "gravity_compensator",
    "payload_error", "thermal_expansion", "encoder_jump", "frame_jump", "marker_slip",
    "tracker_distortion", "torque_coupling", "torque_tilt",
)  # fmt: skip
# They correct the arm and explain nothing.
NAMELESS = (
    "joint_curve", "residual_field", "residual_step", "torque_response", "approach_response",
    "load_response",
)  # fmt: skip


def judged(
    world: World, visible: Path, fresh: Path, answer: Json | None, extended: str
) -> dict[str, Any]:
    """What the campaign's answer is worth; the new poses are shown to the tool only now.

    Rms lengths in mm of the errors at new poses: geometry_mm of the cell as it is, tool_mm of the
    `extended` one, both as `identify --test` has them, None where it fails; oracle_mm; gap_um: rms
    of a coordinate of what geometry leaves of the effects; strengths: mean squares of its parts
    over that of all.
    shares: of every part that is stated with one, its truth and its interval; names: what is
    claimed to be there, the mean square of what its kind truly does at that place over that of the
    gap, and whether an arm of this kind has it; missed: parts above SMALL without a component.
    """
    sights = Sights.of(world)
    shutil.copyfile(fresh, visible / NEW)
    gap = gap_of(sights)
    stated = {} if answer is None else stated_parts(answer)
    covered = [p for key in stated for p in matching(gap, key)]
    strengths = {part: gap.strength([part]) for part in gap.parts}
    return {
        "geometry_mm": tested(visible, "cell.toml"),
        "tool_mm": None if answer is None else tested(visible, extended),
        "oracle_mm": 1e3 * oracle_error(sights),
        "gap_um": 1e6 * gap.rms,
        "strengths": {":".join(part): size for part, size in strengths.items()},
        "shares": [
            _share(part, own, strength(gap, part))
            for part, found in stated.items()
            if (own := [c for c in found if "share_ci90" in c and c.get("share") is not None])
        ],
        "names": [] if answer is None else [
            {"name": name, "true": true, "right": true >= ABSENT_BELOW and known}
            for name, part in named_parts(answer, stated)
            for true, known in [(strength(gap, part), name.partition(":")[0] not in ABSENT)]
        ],
        "missed": [] if answer is None else [
            ":".join(p) for p in gap.parts if p not in covered and strengths[p] >= SMALL
        ],
    }  # fmt: skip


def over_oracle(whole: Json, key: str = "tool_mm") -> float:
    """The tool's error, or that of geometry, over the oracle's; infinite where there is none."""
    return np.inf if whole[key] is None else float(whole[key] / whole["oracle_mm"])


def tested(visible: Path, cell: str) -> float | None:
    """Rms error in mm of the identified `cell` at the NEW poses in the visible folder."""
    if run(visible, "identify", cell, "data.csv", "--test", NEW, "-o", RESULT).exit != 0:
        return None
    result = json.loads((visible / RESULT).read_text(encoding="utf-8"))
    return float(result["test"]["rms_um"]) / 1e3


def stated_parts(answer: Json) -> dict[Part, list[Json]]:
    """The components of the answer by kind and place; none where it has no such list."""
    out: dict[Part, list[Json]] = {}
    for c in answer.get("components") or ():
        key = (kind_of(c["family"]), place_of(str(c.get("where") or "")))
        out.setdefault(key, []).append(c)
    return out


def named_parts(answer: Json, stated: Mapping[Part, Sequence[Json]]) -> list[tuple[str, Part]]:
    """What is claimed to be there, as "name:where" and its kind and place: components held to be
    likely, and effects of the catalogue that no component stands for."""
    out = []
    for (kind, where), found in stated.items():
        for c in found:
            if float(c.get("probability") or 0.0) >= LIKELY and c.get("effect") not in NAMELESS:
                out.append((f"{c.get('effect') or kind}:{where}", (kind, where)))
    for e in answer["effects"]:
        part = FAMILY.get(e["effect"], "any"), place_of(e["where"])
        name = f"{e['effect']}:{part[1]}"
        if e["effect"] not in NAMELESS and name not in [n for n, _ in out]:
            out.append((name, part))
    return out


def kind_of(family: str) -> str:
    return KIND.get(family, family)


def place_of(where: str) -> str:
    """A link is where its joint is; what the tracker does is as if the base did it."""
    if where.startswith("link"):
        return "joint" + where.removeprefix("link")
    return "base" if where in ("tracker", "base") else where


def matching(gap: Gap, part: Part) -> list[Part]:
    """The true parts that a stated one stands for: joint 1 turns as the base does."""
    kind, where = part
    all_places = where in ("", "all", "arm", "joints")
    return [
        (f, w)
        for f, w in gap.parts
        if kind in ("any", kind_of(f))
        and (w == where or all_places or (w, where) == ("base", "joint1"))
    ]


def strength(gap: Gap, part: Part) -> float:
    """Of the squared gap, what goes with this part when it is the last to be added."""
    true = matching(gap, part)
    return gap.strength(true) if true else 0.0


def _share(part: Part, found: Sequence[Json], true: float) -> dict[str, Any]:
    """Several of one kind at one place add up, their intervals' halves in quadrature."""
    low, high = np.array([c["share_ci90"] for c in found], dtype=float).T
    each = np.array([c["share"] for c in found], dtype=float)
    middle = float(each.sum())
    ends = middle - float(np.linalg.norm(each - low)), middle + float(np.linalg.norm(high - each))
    return {
        "kind": part[0], "where": part[1], "true": true, "stated": middle,
        "low": ends[0], "high": ends[1], "held": ends[0] <= true <= ends[1],
    }  # fmt: skip
