"""The results as one table.

    python table.py RESULTS…

prints that of the worlds done so far, also while the study runs.  Several results are those of one
study whose suites ran apart.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from instrument import VARIANTS
from scipy.stats import norm
from score import Record, judged
from suites import FEW_POSES, MANY_POSES, SUITES
from whole_score import SMALL, over_oracle

from elastocal.studies import read_results

FAR, WELL_APART = 5.0, 10.0  # d
NEARLY_CERTAIN = 0.97
ALLOWED_SECONDS = 10.0
DISTANCES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, np.inf)
BINS = 10  # of stated probabilities
DEARER = 1.1
UNANSWERABLE = ("outside", "left_out", "whole", "whole300")
Bar = float | None
Line = tuple[str, str, str, str, object, str]  # worlds, measure, bar, measured, n, met


def records_of(frame: pd.DataFrame) -> list[Record]:
    """The records of the study's rows, with the version of elastocal that each was made by."""
    lines = zip(frame["record"], frame["elastocal"], strict=True)
    return [json.loads(text) | {"version": version} for text, version in lines]


def report(done: Sequence[Record]) -> str:
    f = pd.DataFrame([judged(r) for r in done])
    head = (
        f"# Blind check of `diagnose`, seed {' and '.join(map(str, sorted(set(f['seed']))))}\n\n"
        f"{date.today().isoformat()}, elastocal {', '.join(sorted(set(f['version'])))}, "
        f"{len(f)} worlds. Intervals: Wilson, 95 %.\n"
    )
    table = [("worlds", "measure", "bar", "measured", "n", "met"), ("---",) * 6]
    table += [each for each in lines(f) if each[4]]
    return head + "\n" + "\n".join(f"| {' | '.join(map(str, row))} |" for row in table) + "\n"


def line(
    worlds: str,
    measure: str,
    value: float,
    n: int,
    least: Bar = None,
    most: Bar = None,
    told: str = "",
) -> Line:
    """A measure of n worlds beside its bar, which the value itself has to meet."""
    limits = [f"{sign} {v:g}" for sign, v in (("≥", least), ("≤", most)) if v is not None]
    met = (least is None or value >= least) and (most is None or value <= most)
    said = ("yes" if met else "NO") if limits else ""
    return worlds, measure, ", ".join(limits), told or f"{value:.2f}", n, said


def share(worlds: str, measure: str, hits: Any, least: Bar = None, most: Bar = None) -> Line:
    k, n = int(sum(map(bool, hits))), len(hits)
    told = f"{k / n:.3f} ({wilson(k, n)})" if n else ""
    return line(worlds, measure, k / n if n else np.nan, n, least, most, told)


def wilson(k: int, n: int) -> str:
    """The interval of Wilson (1927) for k of n, 95 %."""
    z = norm.ppf(0.975)
    centre = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    return f"{max(centre - half, 0.0):.3f} to {min(centre + half, 1.0):.3f}"


def lines(f: pd.DataFrame) -> Iterator[Line]:
    """Every measure of the check, from the judged worlds; n = 0 where none has been run."""
    suite = {name: f[f["suite"] == name] for name in SUITES}
    yield from _one_effect(suite)
    alike = suite["alike"]
    seen = alike[alike["from_nothing"] >= FAR]
    yield share("alike for any poses", "both reported", alike["both"], 0.95)
    yield share("… with d ≥ 5 from nothing", "both reported", seen["both"])
    yield share("alike for any poses", "one claimed with > 90 %", alike["sure"], most=0.05)
    for variant in VARIANTS:
        most, told = 0.05 if variant == "as_modelled" else 0.07, variant.replace("_", " ")
        for kind, worlds in (("clean", f"no effect, {told}"), ("timeless", f"… {told}, no times")):
            hits = suite[f"{kind}-{variant}"]["claimed"]
            yield share(worlds, "an effect claimed", hits, most=most)
    pairs, two = suite["pairs"], "two effects, × 1.5"
    apart = pairs[pairs["d"] >= WELL_APART]
    yield share(two, "both right", pairs["found"] == 2, 0.80)
    yield share("… the weaker with d ≥ 10", "both right", apart["found"] == 2, 0.88)
    yield share(two, "at least one right", pairs["found"] >= 1, 0.97)
    yield share(two, "none invented", pairs["invented"] == 0, 0.95)
    left_out = suite["left_out"]
    far = left_out[left_out["d"] >= FAR]
    yield from _unknown("outside the catalogue, × 2", suite["outside"])
    yield from _unknown("taken out of the catalogue, × 2", left_out)
    yield from _unknown("… that nothing left in it imitates (d ≥ 5)", far)
    dearer = left_out["dearer"].dropna().astype(float)
    told = f"error at new poses ≤ {DEARER:g} of that with the effect (median {dearer.median():.3g})"
    yield share("taken out of the catalogue, × 2", told, dearer <= DEARER)
    yield from _probabilities(f[~f["suite"].isin(UNANSWERABLE)])
    for poses, name in ((FEW_POSES, "catalogue"), (MANY_POSES, "catalogue300")):
        yield from _reduction(f"shrinkage, {poses} poses", suite[name])
    for poses, name in ((FEW_POSES, "plan"), (20, "plan20")):
        yield from _extra(f"after {poses} poses", suite[name])
    for poses, name, bars in ((60, "whole", (1.25, 1.6)), (300, "whole300", (1.1, 1.3))):
        yield from _whole(f"whole arms, {poses} poses", suite[name], *bars)
    yield share("all", "no answer", f["verdict"] == "failed", most=0.0)
    single = f[f["whole"].isna()]
    for poses, at_least in ((FEW_POSES, 0.95), (MANY_POSES, None)):
        yield _time(f"{poses} poses", single[single["poses"] == poses], at_least)


def _one_effect(suite: dict[str, pd.DataFrame]) -> Iterator[Line]:
    """By poses, effect, size, and distance d to the nearest rival."""
    one, many = suite["catalogue"], suite["catalogue300"]
    far = one[one["d"] >= FAR]
    yield share("one effect, 60 poses", "right", one["outcome"] == "right", 0.92)
    yield share("one effect, 60 poses", "wrong name", one["outcome"] == "wrong", most=0.03)
    yield share("… with d ≥ 5", "named outright", far["outright"], 0.98)
    yield share("one effect, 300 poses", "right", many["outcome"] == "right", 0.96)
    for effect, some in one.groupby("effect", sort=False):
        yield share(f"… {effect}", "right", some["outcome"] == "right")
    for factor, some in suite["sizes"].groupby("factor"):
        yield share(f"… {factor:g} times its size", "right", some["outcome"] == "right")
    both = pd.concat([one, suite["sizes"]])
    for low, high in pairwise(DISTANCES):
        some = both[(both["d"] >= low) & (both["d"] < high)]
        worlds = f"… d {low:g} to {high:g}" if np.isfinite(high) else f"… d ≥ {low:g}"
        yield share(worlds, "right", some["outcome"] == "right")
        yield share(worlds, "named outright", some["outright"])
        yield share(worlds, "wrong name", some["outcome"] == "wrong")


def _unknown(worlds: str, f: pd.DataFrame) -> Iterator[Line]:
    called, claim = f["verdict"] == "unknown_effect", "an effect of the catalogue claimed"
    yield share(worlds, "unknown_effect", called, 0.85)
    yield share(worlds, "its location right", f[called]["located"], 0.8)
    yield share(worlds, f"{claim} with > 90 %", f["sure"], most=0.05)


def _probabilities(f: pd.DataFrame) -> Iterator[Line]:
    """Of every effect named, in worlds whose effects the catalogue has, or which have none."""
    named = [both for each in f["probabilities"] for both in each]
    p, right = np.array(named, dtype=float).reshape(-1, 2).T
    at = np.minimum((p * BINS).astype(int), BINS - 1)
    # Mean of |probability − share right| over all effects named, by ten equal bins.
    error = sum(abs((p - right)[at == k].sum()) for k in range(BINS)) / max(len(p), 1)
    worlds = "all but outside and taken out"
    yield line(worlds, "expected calibration error", error, len(p), None, 0.03, f"{error:.3f}")
    yield share(worlds, "right where named with ≥ 0.97", right[p >= NEARLY_CERTAIN], 0.97)


def _reduction(worlds: str, f: pd.DataFrame) -> Iterator[Line]:
    """Where exactly the true effect was found."""
    done = f[f["reduction"].notna()]
    yield share(worlds, "90 % interval holds the truth", done["held"], 0.87, 0.93)
    if n := len(done):
        over = (done["reduction"] - done["stated"]).to_numpy(dtype=float)
        told = f"{over.mean():+.3f} ± {1.96 * over.std() / np.sqrt(n):.3f}"
        what = "bias of the remaining fraction"
        yield line(worlds, what, float(over.mean()), n, -0.05, 0.05, told)


def _extra(after: str, f: pd.DataFrame) -> Iterator[Line]:
    """Of the worlds for which extra poses were proposed and measured."""
    for least in (NEARLY_CERTAIN, 0.9, 0.0):
        some = f[f["promised"] >= least]
        worlds = f"extra poses {after}" + (f", ≥ {least:g} predicted" if least else "")
        if len(some):
            told = f"told apart ({some['promised'].mean():.3f} predicted)"
            bar = 0.95 if least == NEARLY_CERTAIN else None
            yield share(worlds, told, some["planned"], bar)
            yield share(worlds, "… by as many random poses", some["random"])
    yield share(f"rivals left {after}", "separable by poses, as said", f["separable"].dropna())


def _whole(worlds: str, f: pd.DataFrame, median: float, most: float) -> Iterator[Line]:
    """Errors at new poses over those of the oracle; shares; names."""
    scored, n = list(f["whole"]), len(f)
    if not n:
        return
    ratios, plain = ([over_oracle(w, key) for w in scored] for key in ("tool_mm", "geometry_mm"))
    for measure, values, at, bar in (
        ("error over the oracle's: median", ratios, 0.5, median),
        ("… in 90 % of the arms", ratios, 0.9, most),
        ("error of geometry alone over the oracle's: median", plain, 0.5, None),
    ):
        yield line(worlds, measure, np.quantile(values, at, method="higher"), n, None, bar)
    yield share(worlds, "no worse than geometry alone", np.array(ratios) <= np.array(plain))
    held = [s["held"] for w in scored for s in w["shares"]]
    yield share(worlds, "90 % interval of a share holds the truth", held, 0.85, 0.95)
    names = [n for w in scored for n in w["names"]]
    yield share(worlds, "wrong among what is named", [not n["right"] for n in names], None, 0.05)
    small = [not n["right"] or n["true"] < SMALL for n in names]
    yield share(worlds, "… or below a hundredth of the mean square", small)
    parts = [(w, part) for w in scored for part, size in w["strengths"].items() if size >= SMALL]
    missed = [part in w["missed"] for w, part in parts]
    yield share(worlds, "parts above that which nothing stands for", missed)
    yield _time(worlds, f)


def _time(worlds: str, f: pd.DataFrame, at_least: float | None = None) -> Line:
    *before, told, n, met = share(worlds, "within 10 s", f["seconds"] <= ALLOWED_SECONDS, at_least)
    told += f"; median {f['seconds'].median():.1f} s, largest {f['seconds'].max():.1f} s"
    return *before, told, n, met


if __name__ == "__main__":
    print(report([r for folder in sys.argv[1:] for r in records_of(read_results(folder))]))
