"""What counts as right of a whole arm: shares of the gap, and names.

The diagnosis lists `components`, each a family of errors at a place with its share of the gap
(of the squared gap: what goes when it is added last) and 90 % interval.  Families
that act by the same load, and the error against a joint's angle under any name, are one *kind*
here; a place without a number stands for all places of its kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from whole_oracle import Gap

Json = Mapping[str, Any]
Part = tuple[str, str]

SMALL = 0.01  # of the gap, in mean squares: what is less need not be found
ABSENT_BELOW = 1e-4  # a hundredth of the gap's rms: what is less is as good as absent
LIKELY = 0.5
KIND = {"torque": "load", "gravity": "load", "load": "load"}
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
NAMELESS = ("joint_curve", "residual_field")  # correct the arm, explain nothing


@dataclass(frozen=True)
class Share:
    """One stated share: of which kind and place, the truth, the interval, and whether it holds."""

    kind: str
    where: str
    true: float
    stated: float
    low: float
    high: float

    @property
    def held(self) -> bool:
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Name:
    """What is claimed to be there, "name:where", the mean square of what its kind truly does at
    that place over that of the gap, and whether an arm of this kind has such a thing at all."""

    name: str
    true: float
    known: bool

    @property
    def right(self) -> bool:
        return self.known and self.true >= ABSENT_BELOW


@dataclass(frozen=True)
class Scored:
    """shares: of every part that is stated with one; names: what is claimed to be there; missed:
    parts above SMALL of the gap that no component stands for."""

    shares: tuple[Share, ...]
    names: tuple[Name, ...]
    missed: tuple[str, ...]


def score_parts(gap: Gap, answer: Json) -> Scored:
    stated = stated_parts(answer)
    shares = []
    for (kind, where), found in stated.items():
        own = [c for c in found if "share_ci90" in c and c.get("share") is not None]
        if own:
            shares.append(_share(kind, where, own, strength(gap, (kind, where))))
    names = [
        Name(name, strength(gap, part), name.partition(":")[0] not in ABSENT)
        for name, part in named_parts(answer, stated)
    ]
    covered = [p for key in stated for p in matching(gap, key)]
    missed = [
        f"{family}:{where}"
        for family, where in gap.parts
        if (family, where) not in covered and gap.strength([(family, where)]) >= SMALL
    ]
    return Scored(tuple(shares), tuple(names), tuple(missed))


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
    """The true parts that a stated one stands for."""
    kind, where = part
    return [
        (f, w)
        for f, w in gap.parts
        if kind in ("any", kind_of(f)) and (w == where or where in imitated(w))
    ]


def imitated(where: str) -> tuple[str, ...]:
    """Other words for a true place: all of its kind; joint 1 turns as the base does."""
    return ("", "all", "arm", "joints") + (("joint1",) if where == "base" else ())


def strength(gap: Gap, part: Part) -> float:
    """Of the squared gap, what goes with this part when it is the last to be added."""
    true = matching(gap, part)
    return gap.strength(true) if true else 0.0


def _share(kind: str, where: str, found: Sequence[Json], true: float) -> Share:
    """Several of one kind at one place add up, their intervals' halves in quadrature."""
    middle = sum(float(c["share"]) for c in found)
    below = np.hypot.reduce([float(c["share"]) - float(c["share_ci90"][0]) for c in found])
    above = np.hypot.reduce([float(c["share_ci90"][1]) - float(c["share"]) for c in found])
    return Share(kind, where, true, middle, middle - float(below), middle + float(above))
