"""The results as tables: bars, confusion, reliability, size, distance, poses.

    python result_tables.py RESULTS…

prints those of the worlds done so far, also while the study runs, and draws reliability.png here.
Several results are those of one study whose suites ran apart.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from bars import Row, bar_rows, wilson
from calibration import answerable, draw_reliability, reliability
from records import Record
from scipy.stats import norm
from score import claims, is_unknown, location_right, one_effect, outright, sure
from suites import FACTORS, SUITES, WHOLE_SUITES
from whole_world import over_oracle

from elastocal.studies.study_results import read_results

DISTANCES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, np.inf)


def records_of(frame: pd.DataFrame) -> list[Record]:
    """The records of the study's rows, with the version of elastocal that each was made by."""
    lines = zip(frame["record"], frame["elastocal"], strict=True)
    return [json.loads(text) | {"version": version} for text, version in lines]


def by_suite(done: Iterable[Record]) -> dict[str, list[Record]]:
    every: dict[str, list[Record]] = {suite: [] for suite in SUITES}
    for record in done:
        every[record["suite"]].append(record)
    return every


def report(done: Sequence[Record]) -> str:
    """All tables of these worlds."""
    every = by_suite(done)
    versions = ", ".join(sorted({r["version"] for r in done}))
    seeds = " and ".join(str(seed) for seed in sorted({r["seed"] for r in done}))
    sections = [
        f"# Blind check of `diagnose`, seed {seeds}",
        f"{date.today().isoformat()}, elastocal {versions}, {len(done)} worlds. "
        "Intervals: Wilson, 95 %. An empty row has not been run.",
        "## Bars\n\n" + _bars(bar_rows(every)),
    ]
    if alone := every["catalogue"]:
        sections.append("## One effect, 60 poses: true × answered\n\n" + confusion(alone))
    if apart := [r for name in ("catalogue", "sizes") for r in every[name] if "distances" in r]:
        sections.append("## Distance d to the nearest rival\n\n" + by_distance(apart))
    if every["sizes"]:
        sections.append("## Size over the realistic size\n\n" + by_size(every["sizes"]))
    if every["catalogue300"]:
        sections.append("## Number of poses\n\n" + by_poses(every))
    for suite, title in (("outside", "outside the catalogue"), ("left_out", "taken out of it")):
        if every[suite]:
            sections.append(f"## Effects {title}, twice the size\n\n" + unknown(every[suite]))
    for suite in WHOLE_SUITES:
        if every[suite]:
            poses = every[suite][0]["truth"]["plan"]["poses"]
            sections.append(f"## Whole arms, {poses} poses\n\n" + whole_arms(every[suite]))
    points = reliability(answerable(every))
    sections.append("## Reliability, all but outside and taken out\n\n" + _reliability(points))
    return "\n\n".join(sections) + "\n"


def _bars(rows: Sequence[Row]) -> str:
    return _table(
        ("worlds", "measure", "bar", "measured", "n", "met"),
        [(r.worlds, r.measure, r.bar, r.measured, r.n or "", r.verdict) for r in rows],
    )


def confusion(found: Sequence[Record]) -> str:
    """A row per true effect: shares of the outcomes, and what was named instead."""
    rows = []
    for name, group in _grouped(found, lambda r: r["truth"]["effects"][0]["effect"]).items():
        outcome = Counter(one_effect(r["truth"], r["answer"]) for r in group)
        alone = sum(outright(r["truth"], r["answer"]) for r in group)
        instead = Counter(
            _named(r) for r in group if one_effect(r["truth"], r["answer"]) == "wrong"
        )
        wrong = ", ".join(f"{n} × {label}" for label, n in instead.most_common())
        rows.append((
            name, len(group), outcome["right"], alone, outcome["right"] - alone,
            outcome["vague"], outcome["nothing"], outcome["unknown"], outcome["failed"], wrong,
        ))  # fmt: skip
    total = [len(found), *(sum(int(row[k]) for row in rows) for k in range(2, 9))]
    rows.append(("all", *total, sum(bool(row[9]) for row in rows)))
    return _table(
        ("true", "n", "right", "outright", "in a set ≤ 3", "in a larger set", "nothing", "unknown",
         "failed", "named instead"),
        rows,
    )  # fmt: skip


def _named(r: Record) -> str:
    return " + ".join("|".join(":".join(p) for p in said) for said in claims(r["answer"]))


def by_distance(found: Sequence[Record]) -> str:
    """Outcomes in bins of d, beside the most that any test between two knowns can reach."""
    d = np.array([r["distances"][0]["distance"] for r in found])
    rows = []
    for low, high in itertools.pairwise(DISTANCES):
        chosen = np.flatnonzero((d >= low) & (d < high))
        if len(chosen):
            label = f"{low:g} to {high:g}" if np.isfinite(high) else f"≥ {low:g}"
            bound = f"{norm.cdf(d[chosen] / 2).mean():.2f}"
            rows.append((label, *_outcomes([found[k] for k in chosen]), bound))
    return _table(("d", *OUTCOMES, "mean Φ(d/2)"), rows)


def by_size(found: Sequence[Record]) -> str:
    groups = _grouped(found, lambda r: r["factor"])
    return _table(
        ("factor", *OUTCOMES), [(f"{f:g}", *_outcomes(groups[f])) for f in FACTORS if f in groups]
    )


def by_poses(every: dict[str, list[Record]]) -> str:
    found = every["catalogue"] + every["catalogue300"]
    groups = _grouped(found, lambda r: r["truth"]["plan"]["poses"])
    return _table(("poses", *OUTCOMES), [(str(n), *_outcomes(g)) for n, g in groups.items()])


OUTCOMES = ("n", "right", "outright", "wrong", "nothing", "unknown", "larger set or failed")


def _outcomes(group: Sequence[Record]) -> tuple[str, ...]:
    outcome = Counter(one_effect(r["truth"], r["answer"]) for r in group)
    alone = sum(outright(r["truth"], r["answer"]) for r in group)
    counts = (
        outcome["right"], alone, outcome["wrong"], outcome["nothing"], outcome["unknown"],
        outcome["vague"] + outcome["failed"],
    )  # fmt: skip
    return (str(len(group)), *(f"{n / len(group):.3f}" for n in counts))


def unknown(found: Sequence[Record]) -> str:
    """A row per effect: called unknown, its location right, an effect of the catalogue claimed."""
    rows = []
    for name, group in _grouped(found, lambda r: r["truth"]["effects"][0]["effect"]).items():
        missed = [r for r in group if is_unknown(r["answer"])]
        located = sum(location_right(r["truth"], r["answer"]) for r in missed)
        over = [r for r in group if sure(r["answer"])]
        instead = Counter(_named(r) for r in over)
        told = ", ".join(f"{n} × {label}" for label, n in instead.most_common(5))
        rows.append((name, len(group), len(missed), located, len(over), told))
    return _table(("true", "n", "unknown", "located", "claimed with > 90 %", "as"), rows)


def whole_arms(found: Sequence[Record]) -> str:
    """Errors by arm and by whether the approach is recorded; shares by what they are errors
    against."""
    rows = []
    for (arm, told), group in _grouped(found, _arm).items():
        ratios = [np.array([over_oracle(r["whole"], f"{k}_mm") for r in group])
                  for k in ("tool", "geometry")]  # fmt: skip
        oracle = np.median([r["whole"]["oracle_mm"] for r in group])
        each = [f"{np.quantile(x, q, method='higher'):.2f}" for x in ratios for q in (0.5, 0.9)]
        rows.append((arm, told, len(group), f"{oracle:.4f}", *each))
    head = ("arm", "approach", "n", "oracle mm", "tool over it", "90 %", "geometry over it", "90 %")
    errors = _table(head, rows)
    kinds = _grouped([s for r in found for s in r["whole"]["shares"]], lambda s: s["kind"])
    if not kinds:
        return errors
    each_kind = [
        (kind, len(group), f"{np.mean([s['held'] for s in group]):.3f}",
         f"{np.median([s['stated'] - s['true'] for s in group]):+.3f}",
         f"{np.median([s['high'] - s['low'] for s in group]):.3f}")
        for kind, group in kinds.items()
    ]  # fmt: skip
    head = ("share of", "n", "interval holds it", "median bias", "median width")
    return f"{errors}\n\n{_table(head, each_kind)}"


def _arm(r: Record) -> tuple[str, str]:
    told = r["truth"]["plan"]["told"]["approach"]
    return r["truth"]["arm"], "recorded" if told else "order of rows"


def _reliability(points: Sequence[tuple[float, float, int]]) -> str:
    rows = [(f"{p:.3f}", f"{right:.3f}", wilson(round(right * n), n), n) for p, right, n in points]
    return _table(("mean probability", "share right", "interval", "n"), rows)


def _grouped(found: Sequence[Record], key: Callable[[Record], object]) -> dict:
    groups: dict[object, list[Record]] = {}
    for r in found:
        groups.setdefault(key(r), []).append(r)
    return groups


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(c).replace("|", "\\|") for c in r) + " |" for r in lines)


if __name__ == "__main__":
    found = [r for folder in sys.argv[1:] for r in records_of(read_results(folder))]
    print(report(found))
    draw_reliability(reliability(answerable(by_suite(found))), Path("reliability.png"))
