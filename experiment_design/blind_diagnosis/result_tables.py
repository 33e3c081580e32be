"""The results as tables: bars, confusion, reliability, size, distance, poses.

    python result_tables.py RESULTS…

prints those of the worlds done so far, also while the study runs, and draws reliability.png here.
Several results are those of one study whose suites ran apart.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from draw import ALIKE
from instrument import VARIANTS
from records import Record
from scipy.stats import norm
from score import SURE, both_reported, claims, location_right, one_effect, pair, told_apart, truths
from suites import FEW_POSES, MANY_POSES, SUITES, WHOLE_SUITES
from whole_score import SMALL
from whole_world import over_oracle

from elastocal.studies.results import read_results

FAR, WELL_APART = 5.0, 10.0  # d
NEARLY_CERTAIN = 0.97
ALLOWED_SECONDS = 10.0
DISTANCES = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, np.inf]
BINS = 10  # of stated probabilities
CAMPAIGNS = {
    "planned": "told apart", "random": "… by as many random poses",
    "random_twice": "… by twice as many random poses",
}  # fmt: skip


def records_of(frame: pd.DataFrame) -> list[Record]:
    """The records of the study's rows, with the version of elastocal that each was made by."""
    lines = zip(frame["record"], frame["elastocal"], strict=True)
    return [json.loads(text) | {"version": version} for text, version in lines]


def judged(done: Sequence[Record]) -> pd.DataFrame:
    """One row for each world: what is asked of it, and how its answer stands to its truth."""
    return pd.DataFrame([_row(r) for r in done])


def _row(r: Record) -> dict[str, Any]:
    truth, answer = r["truth"], r["answer"]
    said = [] if answer is None else claims(answer)
    true, verdict = truths(truth), "failed" if answer is None else answer["verdict"]
    d, plan = r.get("distances"), answer["extra_plan"] if answer and r.get("extra") else None
    matched = pair(truth, answer)
    rival = ALIKE.get(":".join(true[0]), "") if r["suite"] == "alike" else ""
    shrunk = [answer["effects"][0][key] for key in ("gap_reduction", "gap_reduction_ci90")] if (
        "reduction" in r
    ) else [np.nan, (np.nan, np.nan)]  # fmt: skip
    left = (answer or {}).get("extra_plan")
    return {
        "suite": r["suite"], "version": r["version"], "seed": r["seed"], "factor": r["factor"],
        "seconds": r["seconds"], "poses": truth["plan"]["poses"], "verdict": verdict,
        "effect": true[0][0] if true else "",
        "outcome": one_effect(truth, answer) if len(true) == 1 else "",
        "outright": verdict == "explained" and said == [[place] for place in true],
        "named": " + ".join("|".join(":".join(p) for p in members) for members in said),
        "claimed": verdict not in ("failed", "nothing_significant"),
        "sure": any(e["probability"] > SURE for e in (answer or {"effects": ()})["effects"]),
        "located": verdict == "unknown_effect" and location_right(truth, answer),
        "both": bool(rival) and both_reported(truth, tuple(rival.split(":")), answer),
        "found": matched.found, "invented": matched.invented,
        "probabilities": [(e["probability"], (e["effect"], e["where"]) in true)
                          for e in (answer or {"effects": ()})["effects"]],
        "d": min(x["distance"] for x in d) if d else np.nan,
        "from_nothing": d[0]["nothing"] if d else np.nan,
        "reduction": r.get("reduction", np.nan), "stated": shrunk[0],
        "low": shrunk[1][0], "high": shrunk[1][1],
        "promised": plan["probability_after"] if plan else np.nan,
        "separable": left["separable"] if left else None,
        "whole": r.get("whole"), "arm": truth.get("arm"),
        "told": truth["plan"].get("told", {}).get("approach"),
    } | {
        name: bool(plan) and told_apart(truth, plan, r["extra"][name]) for name in CAMPAIGNS
    }  # fmt: skip


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
    worlds: str, measure: str, hits: Sequence[Any], at_least: float = 0.0, at_most: float = 1.0
) -> Row:
    """A share with its bar, met by the share itself."""
    low, high = at_least > 0, at_most < 1
    bar = f"{at_least:g} to {at_most:g}" if low and high else (
        f"≥ {at_least:g}" if low else f"≤ {at_most:g}" if high else ""
    )  # fmt: skip
    k, n = int(sum(map(bool, hits))), len(hits)
    if not n:
        return Row(worlds, measure, bar)
    told = f"{k / n:.3f} ({wilson(k, n)})"
    return Row(worlds, measure, bar, told, n, at_least <= k / n <= at_most)


def bar_rows(f: pd.DataFrame) -> list[Row]:
    """Every bar of the check, from the judged worlds."""
    suite = {name: f[f["suite"] == name] for name in SUITES}
    one, alike, pairs = suite["catalogue"], suite["alike"], suite["pairs"]
    far, seen = one[one["d"] >= FAR], alike[alike["from_nothing"] >= FAR]
    left_out, two = suite["left_out"], "two effects, × 1.5"
    apart = pairs[pairs["d"] >= WELL_APART]
    many = suite["catalogue300"]["outcome"]
    rows = [
        share("one effect, 60 poses", "right", one["outcome"] == "right", 0.92),
        share("one effect, 60 poses", "wrong name", one["outcome"] == "wrong", at_most=0.03),
        share("… with d ≥ 5", "named outright", far["outright"], 0.98),
        share("one effect, 300 poses", "right", many == "right", 0.96),
        share("alike for any poses", "both reported", alike["both"], 0.95),
        share("… with d ≥ 5 from nothing", "both reported", seen["both"]),
        share("alike for any poses", "one claimed with > 90 %", alike["sure"], at_most=0.05),
    ]
    for variant in VARIANTS:
        most, told = 0.05 if variant == "as_modelled" else 0.07, variant.replace("_", " ")
        for kind, worlds in (("clean", f"no effect, {told}"), ("timeless", f"… {told}, no times")):
            hits = suite[f"{kind}-{variant}"]["claimed"]
            rows.append(share(worlds, "an effect claimed", hits, at_most=most))
    rows += [
        share(two, "both right", pairs["found"] == 2, 0.80),
        share("… the weaker with d ≥ 10", "both right", apart["found"] == 2, 0.88),
        share(two, "at least one right", pairs["found"] >= 1, 0.97),
        share(two, "none invented", pairs["invented"] == 0, 0.95),
        *_unknown("outside the catalogue, × 2", suite["outside"]),
        *_unknown("taken out of the catalogue, × 2", left_out),
        *_unknown("… that nothing left in it imitates (d ≥ 5)", left_out[left_out["d"] >= FAR]),
        *_probabilities(f),
        *_shrinkage("60 poses", suite["catalogue"]),
        *_shrinkage("300 poses", suite["catalogue300"]),
        *_plan("60 poses", suite["plan"]),
        *_plan("20 poses", suite["plan20"]),
        *_whole("60 poses", suite["whole"], 1.25, 1.6),
        *_whole("300 poses", suite["whole300"], 1.1, 1.3),
        share("all", "no answer", f["verdict"] == "failed", at_most=0.0),
    ]
    single = f[~f["suite"].isin(WHOLE_SUITES)]
    for poses, at_least in ((FEW_POSES, 0.95), (MANY_POSES, 0.0)):
        rows.append(_time(f"{poses} poses", single[single["poses"] == poses], at_least))
    return rows


def _unknown(worlds: str, f: pd.DataFrame) -> Iterator[Row]:
    called, claim = f["verdict"] == "unknown_effect", "an effect of the catalogue claimed"
    yield share(worlds, "unknown_effect", called, 0.85)
    yield share(worlds, "its location right", f[called]["located"], 0.8)
    yield share(worlds, f"{claim} with > 90 %", f["sure"], at_most=0.05)


def _probabilities(f: pd.DataFrame) -> Iterator[Row]:
    named = answerable(f)
    worlds, bar = "all but outside and taken out", "≤ 0.03"
    row = Row(worlds, "expected calibration error", bar)
    if n := len(named):
        # Mean of |probability − share right| over all effects named.
        error = sum(k * abs(p - right) for p, right, k in reliability(named)) / n
        row = replace(row, measured=f"{error:.3f}", n=n, met=error <= 0.03)
    yield row
    certain = [right for p, right in named if p >= NEARLY_CERTAIN]
    yield share(worlds, "right where named with ≥ 0.97", certain, 0.97)


def answerable(f: pd.DataFrame) -> list[tuple[float, bool]]:
    """Probability of every effect named, and whether it is there, of worlds whose effects the
    catalogue has, or which have none."""
    known = f[~f["suite"].isin(("outside", "left_out", *WHOLE_SUITES))]
    return [both for each in known["probabilities"] for both in each]


def reliability(named: Sequence[tuple[float, bool]]) -> list[tuple[float, float, int]]:
    """(mean probability, share right, number) of the effects named, in ten equal bins."""
    p, right = np.array([(p, r) for p, r in named], dtype=float).reshape(-1, 2).T
    at = np.minimum((p * BINS).astype(int), BINS - 1)
    bins = [at == k for k in range(BINS) if np.any(at == k)]
    return [(float(p[b].mean()), float(right[b].mean()), int(b.sum())) for b in bins]


def _shrinkage(poses: str, f: pd.DataFrame) -> Iterator[Row]:
    """Where exactly the true effect was found."""
    done = f[f["reduction"].notna()]
    held = done["reduction"].between(done["low"], done["high"])
    yield share(f"shrinkage, {poses}", "90 % interval holds the truth", held, 0.87, 0.93)
    row = Row(f"shrinkage, {poses}", "bias of the remaining fraction", "± 0.05")
    if len(done):
        over = (done["reduction"] - done["stated"]).to_numpy(dtype=float)
        told = f"{over.mean():+.3f} ± {1.96 * over.std() / np.sqrt(len(over)):.3f}"
        row = replace(row, measured=told, n=len(over), met=bool(abs(over.mean()) <= 0.05))
    yield row


def _plan(poses: str, f: pd.DataFrame) -> Iterator[Row]:
    """Of the worlds for which extra poses were proposed and measured."""
    for least, bar in ((NEARLY_CERTAIN, 0.95), (SURE, 0.0), (0.0, 0.0)):
        some = f[f["promised"] >= least]
        worlds = f"extra poses after {poses}" + (f", ≥ {least:g} predicted" if least else "")
        mean = f" ({some['promised'].mean():.3f} predicted)" if len(some) else ""
        for name, measure in CAMPAIGNS.items():
            planned = name == "planned"
            told = measure + (mean if planned else "")
            yield share(worlds, told, some[name], bar if planned else 0.0)
    asked = f["separable"].dropna()
    yield share(f"rivals left after {poses}", "separable by poses, as said", asked)


def _whole(poses: str, f: pd.DataFrame, median: float, most: float) -> Iterator[Row]:
    """Errors at new poses over those of the oracle; shares; names."""
    name, scored = f"whole arms, {poses}", list(f["whole"])
    ratios = np.array([over_oracle(w) for w in scored])
    plain = np.array([over_oracle(w, "geometry_mm") for w in scored])
    yield _quantile(name, "error over the oracle's: median", ratios, 0.5, median)
    yield _quantile(name, "… in 90 % of the arms", ratios, 0.9, most)
    yield _quantile(name, "error of geometry alone over the oracle's: median", plain, 0.5)
    yield share(name, "no worse than geometry alone", ratios <= plain)
    held = [s["held"] for w in scored for s in w["shares"]]
    yield share(name, "90 % interval of a share holds the truth", held, 0.85, 0.95)
    names = [n for w in scored for n in w["names"]]
    yield share(name, "wrong among what is named", [not n["right"] for n in names], at_most=0.05)
    small = [not n["right"] or n["true"] < SMALL for n in names]
    yield share(name, "… or below a hundredth of the mean square", small)
    parts = sum(size >= SMALL for w in scored for size in w["strengths"].values())
    missed = sum(len(w["missed"]) for w in scored)
    hits = [True] * missed + [False] * (parts - missed)
    yield share(name, "parts above that which nothing stands for", hits)
    yield _time(name, f, 0.0)


def _quantile(
    worlds: str, measure: str, values: np.ndarray, at: float, at_most: float | None = None
) -> Row:
    bar = "" if at_most is None else f"≤ {at_most:g}"
    if not len(values):
        return Row(worlds, measure, bar)
    value = float(np.quantile(values, at, method="higher"))
    met = at_most is not None and value <= at_most
    return Row(worlds, measure, bar, f"{value:.2f}", len(values), met)


def _time(worlds: str, f: pd.DataFrame, at_least: float) -> Row:
    seconds = f["seconds"]
    row = share(worlds, "within 10 s", seconds <= ALLOWED_SECONDS, at_least)
    if not len(seconds):
        return row
    told = f"{row.measured}; median {seconds.median():.1f} s, largest {seconds.max():.1f} s"
    return replace(row, measured=told)


def report(done: Sequence[Record]) -> str:
    """All tables of these worlds."""
    f = judged(done)
    suite = {name: f[f["suite"] == name] for name in SUITES}
    sections = [
        f"# Blind check of `diagnose`, seed {' and '.join(map(str, sorted(set(f['seed']))))}",
        f"{date.today().isoformat()}, elastocal {', '.join(sorted(set(f['version'])))}, "
        f"{len(f)} worlds. Intervals: Wilson, 95 %. An empty row has not been run.",
    ]

    def section(title: str, text: str) -> None:
        sections.append(f"## {title}\n\n{text}")

    bars = [(r.worlds, r.measure, r.bar, r.measured, r.n or "", r.verdict) for r in bar_rows(f)]
    section("Bars", _table(("worlds", "measure", "bar", "measured", "n", "met"), bars))
    alone = suite["catalogue"]
    if len(alone):
        section("One effect, 60 poses: true × answered", confusion(alone))
    apart = f[f["suite"].isin(("catalogue", "sizes")) & f["d"].notna()]
    if len(apart):
        bins = pd.cut(apart["d"], DISTANCES, right=False)
        label = {b: f"{b.left:g} to {b.right:g}" if np.isfinite(b.right) else f"≥ {b.left:g}"
                 for b in bins.cat.categories}  # fmt: skip
        bound = norm.cdf(apart["d"] / 2)
        title = "Distance d to the nearest rival"
        section(title, outcomes(apart, "d", bins.map(label), {"mean Φ(d/2)": bound}))
    if len(sizes := suite["sizes"]):
        section("Size over the realistic size", outcomes(sizes, "factor", sizes["factor"]))
    if len(suite["catalogue300"]):
        both = pd.concat([alone, suite["catalogue300"]])
        section("Number of poses", outcomes(both, "poses", both["poses"]))
    for name, title in (("outside", "outside the catalogue"), ("left_out", "taken out of it")):
        if len(suite[name]):
            section(f"Effects {title}, twice the size", unknown(suite[name]))
    for name in WHOLE_SUITES:
        if len(some := suite[name]):
            section(f"Whole arms, {some['poses'].iloc[0]} poses", whole_arms(some))
    points = [(f"{p:.3f}", f"{right:.3f}", wilson(round(right * n), n), n)
              for p, right, n in reliability(answerable(f))]  # fmt: skip
    title = "Reliability, all but outside and taken out"
    section(title, _table(("mean probability", "share right", "interval", "n"), points))
    return "\n\n".join(sections) + "\n"


def confusion(f: pd.DataFrame) -> str:
    """A row per true effect: numbers of the outcomes, and what was named instead."""
    rows = []
    for name, group in f.groupby("effect", sort=False):
        n = group["outcome"].value_counts()
        right, alone = n.get("right", 0), group["outright"].sum()
        counts = (right, alone, right - alone, *(n.get(k, 0) for k in
                  ("vague", "nothing", "unknown", "failed")))  # fmt: skip
        rows.append((name, len(group), *counts, _told(group[group["outcome"] == "wrong"])))
    total = [sum(int(row[k]) for row in rows) for k in range(1, 9)]
    rows.append(("all", *total, sum(bool(row[9]) for row in rows)))
    return _table(
        ("true", "n", "right", "outright", "in a set ≤ 3", "in a larger set", "nothing", "unknown",
         "failed", "named instead"),
        rows,
    )  # fmt: skip


def _told(f: pd.DataFrame, most: int | None = None) -> str:
    return ", ".join(f"{n} × {label}" for label, n in Counter(f["named"]).most_common(most))


def outcomes(
    f: pd.DataFrame, head: str, groups: pd.Series, more: dict[str, np.ndarray] | None = None
) -> str:
    """Shares of the outcomes, and means of `more`, by groups in their order."""
    is_ = {name: f["outcome"] == name for name in ("right", "wrong", "nothing", "unknown")}
    known = np.logical_or.reduce(list(is_.values()))
    each = pd.DataFrame({
        "right": is_["right"], "outright": f["outright"], "wrong": is_["wrong"],
        "nothing": is_["nothing"], "unknown": is_["unknown"], "larger set or failed": ~known,
    } | (more or {}))  # fmt: skip
    digits = dict.fromkeys(more or {}, 2)
    rows = []
    for label, group in each.groupby(groups, observed=True):
        means = [f"{mean:.{digits.get(name, 3)}f}" for name, mean in group.mean().items()]
        rows.append((f"{label:g}" if head == "factor" else label, len(group), *means))
    return _table((head, "n", *each.columns), rows)


def unknown(f: pd.DataFrame) -> str:
    """A row per effect: called unknown, its location right, an effect of the catalogue claimed."""
    rows = [
        (name, len(g), (g["verdict"] == "unknown_effect").sum(), g["located"].sum(),
         g["sure"].sum(), _told(g[g["sure"]], 5))
        for name, g in f.groupby("effect", sort=False)
    ]  # fmt: skip
    return _table(("true", "n", "unknown", "located", "claimed with > 90 %", "as"), rows)


def whole_arms(f: pd.DataFrame) -> str:
    """Errors by arm and by whether the approach is recorded; shares by what they are errors
    against."""
    rows = []
    for (arm, told), group in f.groupby(["arm", "told"], sort=False):
        ratios = [[over_oracle(w, f"{k}_mm") for w in group["whole"]] for k in ("tool", "geometry")]
        oracle = np.median([w["oracle_mm"] for w in group["whole"]])
        each = [f"{np.quantile(x, q, method='higher'):.2f}" for x in ratios for q in (0.5, 0.9)]
        way = "recorded" if told else "order of rows"
        rows.append((arm, way, len(group), f"{oracle:.4f}", *each))
    head = ("arm", "approach", "n", "oracle mm", "tool over it", "90 %", "geometry over it", "90 %")
    errors = _table(head, rows)
    stated = pd.DataFrame([s for w in f["whole"] for s in w["shares"]])
    if stated.empty:
        return errors
    each_kind = [
        (kind, len(g), f"{g['held'].mean():.3f}", f"{(g['stated'] - g['true']).median():+.3f}",
         f"{(g['high'] - g['low']).median():.3f}")
        for kind, g in stated.groupby("kind", sort=False)
    ]  # fmt: skip
    head = ("share of", "n", "interval holds it", "median bias", "median width")
    return f"{errors}\n\n{_table(head, each_kind)}"


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(c).replace("|", "\\|") for c in r) + " |" for r in lines)


def draw_reliability(points: Sequence[tuple[float, float, int]], path: Path) -> None:
    """Share right against stated probability, the area of a dot as the number behind it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    if points:
        p, right, n = (np.array(column) for column in zip(*points, strict=True))
        axes.scatter(p, right, s=200 * n / n.max() + 8)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="stated probability", ylabel="share right")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    found = [r for folder in sys.argv[1:] for r in records_of(read_results(folder))]
    print(report(found))
    draw_reliability(reliability(answerable(judged(found))), Path("reliability.png"))
