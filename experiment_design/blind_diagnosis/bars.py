"""What was to be shown, and what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from calibration import all_named, answerable, calibration_error, reliability
from draw import ALIKE
from instrument import VARIANTS
from records import Record
from scipy.stats import norm
from score import (
    SURE,
    both_reported,
    claimed,
    is_unknown,
    location_right,
    one_effect,
    outright,
    pair,
    place,
    sure,
    told_apart,
    weaker_distance,
)
from suites import FEW_POSES, MANY_POSES, WHOLE_SUITES
from whole_score import SMALL
from whole_world import over_oracle

Records = Mapping[str, Sequence[Record]]

FAR, WELL_APART = 5.0, 10.0  # d
NEARLY_CERTAIN = 0.97
ALLOWED_SECONDS = 10.0


@dataclass(frozen=True)
class Row:
    """One bar: n = 0 where no world of it has been run."""

    worlds: str
    measure: str
    bar: str
    measured: str = ""
    n: int = 0
    met: bool = False

    @property
    def verdict(self) -> str:
        return "" if not (self.n and self.bar) else "yes" if self.met else "NO"


def wilson(k: int, n: int) -> str:
    """The interval of Wilson (1927) for k of n, 95 %."""
    z = norm.ppf(0.975)
    centre = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    return f"{max(centre - half, 0.0):.3f} to {min(centre + half, 1.0):.3f}"


def share(
    worlds: str, measure: str, hits: Sequence[bool], at_least: float = 0.0, at_most: float = 1.0
) -> Row:
    """A share with its bar, met by the share itself."""
    low, high = at_least > 0, at_most < 1
    bar = f"{at_least:g} to {at_most:g}" if low and high else (
        f"≥ {at_least:g}" if low else f"≤ {at_most:g}" if high else ""
    )  # fmt: skip
    k, n = int(np.sum(hits)), len(hits)
    if not n:
        return Row(worlds, measure, bar)
    told = f"{k / n:.3f} ({wilson(k, n)})"
    return Row(worlds, measure, bar, told, n, at_least <= k / n <= at_most)


def bar_rows(every: Records) -> list[Row]:
    """Every bar of the check; `every` holds the records of each suite."""
    return [
        *_one_effect(every),
        *_alike(every["alike"]),
        *_clean(every),
        *_pairs(every["pairs"]),
        *_unknown("outside the catalogue, × 2", every["outside"]),
        *_unknown("taken out of the catalogue, × 2", every["left_out"]),
        *_unknown("… that nothing left in it imitates (d ≥ 5)", _unlike(every["left_out"])),
        *_probabilities(every),
        *_shrinkage("60 poses", every["catalogue"]),
        *_shrinkage("300 poses", every["catalogue300"]),
        *_plan("60 poses", every["plan"]),
        *_plan("20 poses", every["plan20"]),
        *_whole("60 poses", every["whole"], 1.25, 1.6),
        *_whole("300 poses", every["whole300"], 1.1, 1.3),
        *_runs(every),
    ]


def _both(r: Record) -> tuple[Any, Any]:
    return r["truth"], r["answer"]


def _one_effect(every: Records) -> Iterator[Row]:
    found = every["catalogue"]
    outcome = [one_effect(*_both(r)) for r in found]
    yield share("one effect, 60 poses", "right", [o == "right" for o in outcome], 0.92)
    wrong = [o == "wrong" for o in outcome]
    yield share("one effect, 60 poses", "wrong name", wrong, at_most=0.03)
    far = [r for r in found if weaker_distance(r["distances"]) >= FAR]
    yield share("… with d ≥ 5", "named outright", [outright(*_both(r)) for r in far], 0.98)
    right = [one_effect(*_both(r)) == "right" for r in every["catalogue300"]]
    yield share("one effect, 300 poses", "right", right, 0.96)


def _alike(found: Sequence[Record]) -> Iterator[Row]:
    both = [both_reported(r["truth"], _rival(r), r["answer"]) for r in found]
    yield share("alike for any poses", "both reported", both, 0.95)
    observed = [b for r, b in zip(found, both, strict=True) if _from_nothing(r) >= FAR]
    yield share("… with d ≥ 5 from nothing", "both reported", observed)
    yield share("alike for any poses", "one claimed with > 90 %",
                [sure(r["answer"]) for r in found], at_most=0.05)  # fmt: skip


def _from_nothing(r: Record) -> float:
    return float(r["distances"][0]["nothing"]) if "distances" in r else 0.0


def _rival(r: Record) -> tuple[str, str]:
    name, _, where = ALIKE[":".join(place(r["truth"]["effects"][0]))].partition(":")
    return name, where


def _clean(every: Records) -> Iterator[Row]:
    for variant in VARIANTS:
        most = 0.05 if variant == "as_modelled" else 0.07
        hits = [claimed(r["answer"]) for r in every[f"clean-{variant}"]]
        worlds = f"no effect, {variant.replace('_', ' ')}"
        yield share(worlds, "an effect claimed", hits, at_most=most)
        hits = [claimed(r["answer"]) for r in every[f"timeless-{variant}"]]
        yield share(
            f"… {variant.replace('_', ' ')}, no times", "an effect claimed", hits, at_most=most
        )


def _pairs(found: Sequence[Record]) -> Iterator[Row]:
    scored = [(r, pair(*_both(r))) for r in found]
    apart = [p for r, p in scored if weaker_distance(r["distances"]) >= WELL_APART]
    two = "two effects, × 1.5"
    yield share(two, "both right", [p.found == 2 for _, p in scored], 0.80)
    yield share("… the weaker with d ≥ 10", "both right", [p.found == 2 for p in apart], 0.88)
    yield share(two, "at least one right", [p.found >= 1 for _, p in scored], 0.97)
    yield share(two, "none invented", [p.invented == 0 for _, p in scored], 0.95)


def _unknown(worlds: str, found: Sequence[Record]) -> Iterator[Row]:
    called = [r for r in found if is_unknown(r["answer"])]
    yield share(worlds, "unknown_effect", [is_unknown(r["answer"]) for r in found], 0.85)
    yield share(worlds, "its location right", [location_right(*_both(r)) for r in called], 0.8)
    yield share(worlds, "an effect of the catalogue claimed with > 90 %",
                [sure(r["answer"]) for r in found], at_most=0.05)  # fmt: skip


def _unlike(found: Sequence[Record]) -> list[Record]:
    return [r for r in found if "distances" in r and weaker_distance(r["distances"]) >= FAR]


def _probabilities(every: Records) -> Iterator[Row]:
    known = answerable(every)
    p, right = all_named(known)
    worlds, bar = "all but outside and taken out", "≤ 0.03"
    measure = "expected calibration error"
    if len(p):
        error = calibration_error(reliability(known))
        yield Row(worlds, measure, bar, f"{error:.3f}", len(p), error <= 0.03)
    else:
        yield Row(worlds, measure, bar)
    certain = right[p >= NEARLY_CERTAIN].tolist()
    yield share(worlds, "right where named with ≥ 0.97", certain, 0.97)


def _shrinkage(worlds: str, found: Sequence[Record]) -> Iterator[Row]:
    """Where exactly the true effect was found."""
    done = [(r["answer"]["effects"][0], r["reduction"]) for r in found if "reduction" in r]
    held = [e["gap_reduction_ci90"][0] <= true <= e["gap_reduction_ci90"][1] for e, true in done]
    yield share(f"shrinkage, {worlds}", "90 % interval holds the truth", held, 0.87, 0.93)
    name, measure, bar = f"shrinkage, {worlds}", "bias of the remaining fraction", "± 0.05"
    if not done:
        yield Row(name, measure, bar)
        return
    over = np.array([true - e["gap_reduction"] for e, true in done])
    spread = 1.96 * over.std() / np.sqrt(len(over))
    told = f"{over.mean():+.3f} ± {spread:.3f}"
    yield Row(name, measure, bar, told, len(over), abs(float(over.mean())) <= 0.05)


def _plan(poses: str, found: Sequence[Record]) -> Iterator[Row]:
    """Of the worlds for which extra poses were proposed and measured."""
    done = [r for r in found if r.get("extra")]

    def predicted(r: Record) -> float:
        return float(r["answer"]["extra_plan"]["probability_after"])

    for least, bar in ((NEARLY_CERTAIN, 0.95), (SURE, 0.0), (0.0, 0.0)):
        promised = [r for r in done if predicted(r) >= least]
        worlds = f"extra poses after {poses}" + (f", ≥ {least:g} predicted" if least else "")
        told = {name: _told_apart(promised, name) for name in ("planned", "random", "random_twice")}
        mean = f" ({np.mean([predicted(r) for r in promised]):.3f} predicted)" if promised else ""
        yield share(worlds, f"told apart{mean}", told["planned"], bar)
        yield share(worlds, "… by as many random poses", told["random"])
        yield share(worlds, "… by twice as many random poses", told["random_twice"])
    asked = [r for r in found if r["answer"] and r["answer"]["extra_plan"]]
    apart = [r["answer"]["extra_plan"]["separable"] for r in asked]
    yield share(f"rivals left after {poses}", "separable by poses, as said", apart)


def _told_apart(found: Sequence[Record], campaign: str) -> list[bool]:
    return [told_apart(r["truth"], r["answer"]["extra_plan"], r["extra"][campaign]) for r in found]


def _whole(poses: str, found: Sequence[Record], median: float, most: float) -> Iterator[Row]:
    """Errors at new poses over those of the oracle; shares; names."""
    name, scored = f"whole arms, {poses}", [r["whole"] for r in found]
    ratios = np.array([over_oracle(w) for w in scored])
    plain = np.array([over_oracle(w, "geometry_mm") for w in scored])
    yield _quantile(name, "error over the oracle's: median", ratios, 0.5, median)
    yield _quantile(name, "… in 90 % of the arms", ratios, 0.9, most)
    yield _quantile(name, "error of geometry alone over the oracle's: median", plain, 0.5)
    yield share(name, "no worse than geometry alone", (ratios <= plain).tolist())
    held = [s["held"] for w in scored for s in w["shares"]]
    yield share(name, "90 % interval of a share holds the truth", held, 0.85, 0.95)
    names = [n for w in scored for n in w["names"]]
    yield share(name, "wrong among what is named", [not n["right"] for n in names], at_most=0.05)
    small = [not n["right"] or n["true"] < SMALL for n in names]
    yield share(name, "… or below a hundredth of the mean square", small)
    parts = [p for w in scored for p in w["strengths"] if w["strengths"][p] >= SMALL]
    missed = [p for w in scored for p in w["missed"]]
    yield share(name, "parts above that which nothing stands for",
                [True] * len(missed) + [False] * (len(parts) - len(missed)))  # fmt: skip
    yield _time(name, found, 0.0)


def _quantile(
    worlds: str, measure: str, values: np.ndarray, at: float, at_most: float | None = None
) -> Row:
    bar = "" if at_most is None else f"≤ {at_most:g}"
    if not len(values):
        return Row(worlds, measure, bar)
    value = float(np.quantile(values, at, method="higher"))
    met = at_most is not None and value <= at_most
    return Row(worlds, measure, bar, f"{value:.2f}", len(values), met)


def _runs(every: Records) -> Iterator[Row]:
    done = [r for found in every.values() for r in found]
    yield share("all", "no answer", [r["answer"] is None for r in done], at_most=0.0)
    done = [r for suite, found in every.items() if suite not in WHOLE_SUITES for r in found]
    for poses, at_least in ((FEW_POSES, 0.95), (MANY_POSES, 0.0)):
        found = [r for r in done if r["truth"]["plan"]["poses"] == poses]
        yield _time(f"{poses} poses", found, at_least)


def _time(worlds: str, found: Sequence[Record], at_least: float) -> Row:
    seconds = np.array([r["seconds"] for r in found])
    row = share(worlds, "within 10 s", (seconds <= ALLOWED_SECONDS).tolist(), at_least)
    if not len(seconds):
        return row
    told = f"{row.measured}; median {np.median(seconds):.1f} s, largest {seconds.max():.1f} s"
    return replace(row, measured=told)
