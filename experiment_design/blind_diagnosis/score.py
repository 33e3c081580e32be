"""What counts as right: functions of a world's sealed truth and of the published diagnosis alone.

`truth` is truth.json, `answer` diagnosis.json (None where the command failed).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

Place = tuple[str, str]  # effect, where
Json = Mapping[str, Any]
Outcome = Literal["right", "wrong", "vague", "nothing", "unknown", "failed"]

LARGEST_SET = 3  # an ambiguous answer is right where the truth is one of so many
SURE = 0.9


def truths(truth: Json) -> list[Place]:
    return [place(e) for e in truth["effects"]]


def place(e: Json) -> Place:
    return e["effect"], e["where"]


def claims(answer: Json) -> list[list[Place]]:
    """What is said to be there: per effect found, the set of what it may be, itself first."""
    sets = [[place(e) for e in rivals] for rivals in answer["indistinguishable"]]
    out = []
    for finding in answer["effects"]:
        own = place(finding)
        among = [s for s in sets if own in s]
        out.append(min(among, key=lambda s: s.index(own)) if among else [own])
    return out


def one_effect(truth: Json, answer: Json | None) -> Outcome:
    """Of a world with one effect of the catalogue.

    right: the effect and its place, or a set of at most three that holds it, and nothing else.
    wrong: anything else is named.  vague: only a larger set holds the truth.
    """
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
    """The effect at its place is named, and nothing beside it."""
    return answer is not None and answer["verdict"] == "explained" and (
        claims(answer) == [[true] for true in truths(truth)]
    )  # fmt: skip


def told_apart(truth: Json, plan: Json, answer: Json | None) -> bool:
    """The effect is named outright, or among those alone of which the plan said that no pose
    separates them."""
    if answer is None or outright(truth, answer):
        return answer is not None
    said, (true,) = claims(answer), truths(truth)
    if answer["verdict"] != "ambiguous" or len(said) != 1 or true not in said[0]:
        return False
    names = {":".join(rival) for rival in said[0]}
    return any(names <= {*group} for group in plan["inseparable"])


def both_reported(truth: Json, rival: Place, answer: Json | None) -> bool:
    """The effect and the one that is alike stand in the same set."""
    (true,) = truths(truth)
    return answer is not None and any(true in said and rival in said for said in claims(answer))


@dataclass(frozen=True)
class Pair:
    """How many of the true effects are found, and how many claims hold none that is left."""

    found: int
    invented: int


def pair(truth: Json, answer: Json | None) -> Pair:
    """Of a world with several effects; an effect counts as found where a claim of its own, a set of
    at most three, holds it."""
    if answer is None:
        return Pair(0, 0)
    said, true = claims(answer), truths(truth)
    small = [members for members in said if len(members) <= LARGEST_SET]
    return Pair(_matched(small, true), len(said) - _matched(said, true))


def _matched(said: Sequence[list[Place]], true: Sequence[Place]) -> int:
    """The most truths that have a claim each."""
    there = np.array([[t in members for members in said] for t in true], dtype=int)
    there = there.reshape(len(true), len(said))
    return int(there[linear_sum_assignment(there, maximize=True)].sum())


def location_right(truth: Json, answer: Json) -> bool:
    """The stated location is the true place, or a link or joint of its number, or its driver's
    joint.

    A motion of the base is one of the tracker; load and tool hang on the last link; the wrist is
    the last three joints; growth of the whole arm is in any link.
    """
    if answer["location"] is None:
        return False
    where = answer["location"]["where"]
    n_joints = len(truth["arm_values"]["joint_offset_rad"])
    return any(where in _accepted(e, n_joints) for e in truth["effects"])


def _accepted(effect: Json, n_joints: int) -> set[str]:
    where = effect["where"]
    driver = effect.get("location", {}).get("driver", "")
    joints = _numbers(r"(?:joint|link)(\d+)", where) | _numbers(
        r"(?:q|torque|approach)(\d+)", driver
    )
    if where in ("load", "tool"):
        joints.add(n_joints)
    if where == "wrist":
        joints |= {n_joints - 2, n_joints - 1, n_joints}
    if where == "all":
        joints |= set(range(1, n_joints + 1))
    same = {"base", "tracker"} if where in ("base", "tracker") else {where}
    return same | {f"{kind}{j}" for kind in ("joint", "link") for j in joints}


def _numbers(pattern: str, text: str) -> set[int]:
    return {int(j) for j in re.findall(pattern, text)}
