"""What counts as right: functions of a world's sealed truth and of the published diagnosis alone.

`truth` is truth.json, `answer` what is kept of diagnosis.json (None where the command failed).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from draw import ALIKE
from scipy.optimize import linear_sum_assignment

Place = tuple[str, str]  # effect, where
Json = Mapping[str, Any]
Record = dict[str, Any]

LARGEST_SET = 3  # an ambiguous answer is right where the truth is one of so many
SURE = 0.9
CANDIDATES = 10
KEPT = (
    "verdict", "p_value", "probability_nothing", "probability_unknown", "gap", "effects",
    "indistinguishable", "location", "noise", "extra_plan", "warnings",
)  # fmt: skip


def shortened(diagnosis: Json) -> Record:
    """The part of a diagnosis that is kept: without curves, tests and hopeless candidates."""
    kept = {key: diagnosis[key] for key in KEPT}
    kept["components"] = diagnosis.get("components")
    kept["candidates"] = diagnosis["candidates"][:CANDIDATES]
    return kept


def judged(r: Json) -> Record:
    """One row for the record of a world: what is asked of it, and how its answer stands to it."""
    truth, answer = r["truth"], r["answer"]
    said, true = claims(answer), truths(truth)
    found = (answer or {}).get("effects", ())
    d = r.get("distances") or [{"distance": np.nan, "nothing": np.nan}]
    rival = ALIKE.get(":".join(true[0]), "") if r["suite"] == "alike" else ""
    extra = (answer or {}).get("extra_plan")
    reduction = r.get("reduction", np.nan)
    own = found[0] if "reduction" in r else {}
    low, high = own.get("gap_reduction_ci90", (np.nan, np.nan))
    return {
        "suite": r["suite"], "version": r["version"], "seed": r["seed"], "factor": r["factor"],
        "seconds": r["seconds"], "poses": truth["plan"]["poses"],
        "verdict": "failed" if answer is None else answer["verdict"],
        "effect": true[0][0] if true else "", "outcome": one_effect(truth, answer),
        "outright": outright(truth, answer),
        "claimed": answer is not None and answer["verdict"] != "nothing_significant",
        "sure": any(e["probability"] > SURE for e in found),
        "located": location_right(truth, answer),
        "both": bool(rival) and any({true[0], (*rival.split(":"),)} <= {*s} for s in said),
        "found": matched([s for s in said if len(s) <= LARGEST_SET], true),
        "invented": len(said) - matched(said, true),
        "probabilities": [(e["probability"], place(e) in true) for e in found],
        "d": min(x["distance"] for x in d), "from_nothing": d[0]["nothing"],
        "reduction": reduction, "stated": own.get("gap_reduction", np.nan),
        "held": low <= reduction <= high,
        "promised": extra["probability_after"] if extra and r.get("extra") else np.nan,
        "separable": extra["separable"] if extra else None,
        "whole": r.get("whole"), "dearer": r.get("dearer"),
    } | {
        way: told_apart(truth, (extra or {}).get("inseparable", ()), again)
        for way, again in (r.get("extra") or {}).items() if way != "n_poses"
    }  # fmt: skip


def truths(truth: Json) -> list[Place]:
    return [place(e) for e in truth["effects"]]


def place(e: Json) -> Place:
    return e["effect"], e["where"]


def claims(answer: Json | None) -> list[list[Place]]:
    """What is said to be there: per effect found, the set of what it may be, itself first."""
    if answer is None:
        return []
    sets = [[place(e) for e in rivals] for rivals in answer["indistinguishable"]]
    out = []
    for own in map(place, answer["effects"]):
        among = [s for s in sets if own in s]
        out.append(min(among, key=lambda s: s.index(own)) if among else [own])
    return out


def one_effect(truth: Json, answer: Json | None) -> str:
    """Of a world with one effect of the catalogue; "" where it has none or several.

    right: the effect and its place, or a set of at most three that holds it, and nothing else.
    wrong: anything else is named.  vague: only a larger set holds the truth.
    """
    if len(truths(truth)) != 1:
        return ""
    if answer is None:
        return "failed"
    if answer["verdict"] == "nothing_significant":
        return "nothing"
    if answer["verdict"] == "unknown_effect":
        return "unknown"
    (true,) = truths(truth)
    said = claims(answer)
    if len(said) != 1 or true not in said[0]:
        return "wrong"
    return "right" if len(said[0]) <= LARGEST_SET else "vague"


def outright(truth: Json, answer: Json | None) -> bool:
    """The effects at their places are named, and nothing beside them."""
    named = [[true] for true in truths(truth)]
    return answer is not None and answer["verdict"] == "explained" and claims(answer) == named


def told_apart(truth: Json, inseparable: Sequence[Sequence[str]], answer: Json | None) -> bool:
    """The effect is named outright, or among those alone of which the plan said that no pose
    separates them."""
    if answer is None or outright(truth, answer):
        return answer is not None
    said, (true,) = claims(answer), truths(truth)
    if answer["verdict"] != "ambiguous" or len(said) != 1 or true not in said[0]:
        return False
    names = {":".join(rival) for rival in said[0]}
    return any(names <= {*group} for group in inseparable)


def matched(said: Sequence[list[Place]], true: Sequence[Place]) -> int:
    """The most truths that have a claim each that holds them."""
    there = np.array([[t in members for members in said] for t in true], dtype=int)
    there = there.reshape(len(true), len(said))
    return int(there[linear_sum_assignment(there, maximize=True)].sum())


def location_right(truth: Json, answer: Json | None) -> bool:
    """Something unknown is placed where it is, or at a link or joint of its number, or at its
    driver's joint.

    A motion of the base is one of the tracker; load and tool hang on the last link; the wrist is
    the last three joints; growth of the whole arm is in any link.
    """
    if answer is None or answer["verdict"] != "unknown_effect" or answer["location"] is None:
        return False
    n_joints = len(truth["arm_values"]["joint_offset_rad"])
    return any(answer["location"]["where"] in _accepted(e, n_joints) for e in truth["effects"])


def _accepted(effect: Json, n_joints: int) -> set[str]:
    where, driver = effect["where"], effect.get("location", {}).get("driver", "")
    numbers = re.findall(r"(?:joint|link)(\d+)", where)
    numbers += re.findall(r"(?:q|torque|approach)(\d+)", driver)
    first = {"load": n_joints, "tool": n_joints, "wrist": n_joints - 2, "all": 1}
    joints = {*map(int, numbers), *range(first.get(where, n_joints + 1), n_joints + 1)}
    same = {"base", "tracker"} if where in ("base", "tracker") else {where}
    return same | {f"{kind}{j}" for kind in ("joint", "link") for j in joints}
