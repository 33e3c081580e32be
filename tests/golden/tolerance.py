"""How far a result may move before a golden differs: every tolerance in one place.

A golden of an engine (a fit, a diagnosis) lets a value move by `SHARE` of its standard deviation,
which no reader of the result could notice; what has no standard deviation moves by the rules in
RULES, or by the relative ENGINE.  A golden without an engine (an export of a given result, a
simulation with a given seed) computes the same numbers on every machine: EXACT.
"""

from __future__ import annotations

import difflib
import math
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

SHARE = 0.01  # of a standard deviation
EXACT = 1e-6  # relative, where no engine is between the input and the number
ENGINE = 1e-3  # relative, where one is
NOTHING = 1e-13  # of SI units: below it a number is rounding of zero, on any machine
NOTHING_SMALL = 1e-6  # the same of µm and µrad
WIDTH_95 = 3.92  # standard deviations in a 95 % interval
WIDTH_90 = 3.29

# Keys with a rule of their own in goldens of engines, the first that matches: absolute, relative.
RULES = [
    # Monte Carlo with a fixed seed: a last digit of the data decides single draws.
    (re.compile(r"^(p|p_\w+|\w+_p|probability\w*|prob|evidence|stages|places|drivers)$"), 0.02, 0),
    # Logarithms of evidence, and criteria made of them: a twentieth of a nat tips no choice.
    (re.compile(r"^(score|criterion|log_\w+|detectable|evidence_\w+)$"), 0.05, ENGINE),
    # Second moments and what is made of them are as sure as their own estimate, no better.
    (re.compile(r"^(dof|std|cook|leverage|by|skewness|excess_kurtosis|mean_square|\w*share\w*|"
                r"correlations?|\w*ratio\w*|\w*reduction\w*|covariance|mixing|low|high|observed|"
                r"expected|prior_share)$"), 0.002, 0.01),
    # Of plans of nearly one worth rounding decides.
    (re.compile(r"^efficiency\w*$"), 0.003, 0),
    (re.compile(r"^(counts|beyond)$"), 2, 0),  # readings at the edge of a bin
    (re.compile(r"^multiplier$"), 1e-6, 0.01),  # of a constraint that costs nothing: zero
    (re.compile(r"^read_back$"), 0.01, 0),  # µm that rounding leaves in a file that is exact
]  # fmt: skip
# Ends of intervals that are quantiles of draws, which go by the signs that a library gives
# eigenvectors: relative, as far as 2,000 draws tell them.
DRAWN = re.compile(r"predicted_new_poses_um\.ci95\[\d\]$|\.(from|to|at)_um$")
OF_DRAWS = 0.01
# What says how the machine did it, or which of several alike rounding picked, not what came out.
MASKED = {"redundant", "backend", "seconds", "task_seconds", "version", "iterations", "elapsed_s"}

NAMED_BY = ("name", "effect", "driver", "set", "step", "kind", "where")

NUMBER = re.compile(r"[-−+±]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
LOOSE = 0.02  # relative, of a number in a text, and one unit of the last decimal shown


@dataclass(frozen=True)
class Difference:
    """Where a golden and what was found part, and by how much."""

    path: str
    expected: Any
    found: Any
    told: str = ""

    def __str__(self) -> str:
        told = f"   ({self.told})" if self.told else ""
        old, new = (textwrap.shorten(str(v), 300) for v in (self.expected, self.found))
        return f"  {self.path}\n    expected {old}\n    found    {new}{told}"


@dataclass(frozen=True)
class Measure:
    """What a number is measured by: an engine or none, its standard deviation, the size of the
    numbers beside it in a list (a residual of nearly zero is as unsure as its neighbours)."""

    engine: bool
    sd: float = 0.0
    size: float = 0.0


def differences(path: str, expected: Any, found: Any, engine: bool) -> Iterator[Difference]:
    """Every place where `found` is not `expected`; `engine`: values may move as an engine's do."""
    yield from _walk(path, "", expected, found, Measure(engine))


def _walk(path: str, key: str, expected: Any, found: Any, measure: Measure) -> Iterator[Difference]:
    if isinstance(expected, dict) and isinstance(found, dict):
        yield from _records(path, key, expected, found, measure)
    elif isinstance(expected, list) and isinstance(found, list):
        if key.startswith("text "):
            yield from _texts(path, "\n".join(expected), "\n".join(found), measure.engine)
        elif len(expected) != len(found):
            yield Difference(path, f"{len(expected)} entries", f"{len(found)} entries")
        else:
            size = max(measure.size, _size(expected))
            for i, (a, b) in enumerate(zip(expected, found, strict=True)):
                inner = replace(measure, size=size)
                yield from _walk(f"{path}[{label(a, i)}]", key, a, b, inner)
    elif is_number(expected) and is_number(found):
        yield from _numbers(path, key, float(expected), float(found), measure)
    elif isinstance(expected, str) and isinstance(found, str):
        yield from _texts(path, expected, found, measure.engine)
    elif expected != found or type(expected) is not type(found):
        yield Difference(path, expected, found)


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _size(values: list[Any]) -> float:
    """Root mean square of a list of numbers; 0 of any other."""
    if not values or not all(map(is_number, values)):
        return 0.0
    return math.sqrt(sum(v * v for v in values) / len(values))


def label(record: Any, index: int) -> str:
    if isinstance(record, dict):
        parts = [record[k] for k in NAMED_BY if isinstance(record.get(k), str)]
        if parts:
            return " ".join(parts)
    return str(index)


def _records(
    path: str, key: str, expected: dict, found: dict, measure: Measure
) -> Iterator[Difference]:
    for name in expected.keys() - found.keys():
        yield Difference(f"{path}.{name}", expected[name], "nothing")
    for name in found.keys() - expected.keys():
        yield Difference(f"{path}.{name}", "nothing", found[name])
    summary = "entries" in expected
    inner = Measure(
        measure.engine,
        _deviation(expected) if measure.engine else 0.0,
        float(expected.get("rms", 0.0)) if summary else 0.0,
    )
    for name in expected:
        if name in found and name not in MASKED:
            # In a table by name (drivers, stages) and a long list the rule is that of the whole.
            whole = summary or any(rule.match(key) for rule, _, _ in RULES)
            yield from _walk(
                f"{path}.{name}", key if whole else name, expected[name], found[name], inner
            )


def _deviation(record: dict) -> float:
    """The standard deviation that a record states for its value; 0 where it states none."""
    if is_number(record.get("std")):
        return float(record["std"])
    for name, width in (("ci95", WIDTH_95), ("ci90", WIDTH_90), ("ci95_um", WIDTH_95)):
        ends = record.get(name)
        if isinstance(ends, list) and len(ends) == 2 and all(map(is_number, ends)):
            return abs(float(ends[1]) - float(ends[0])) / width
    return 0.0


def _numbers(
    path: str, key: str, expected: float, found: float, measure: Measure
) -> Iterator[Difference]:
    off, sd = abs(found - expected), measure.sd
    nothing = NOTHING_SMALL if re.search(r"_u(m|rad)\b", path) else NOTHING
    allowed = nothing + (ENGINE if measure.engine else EXACT) * max(abs(expected), measure.size)
    if measure.engine:
        rule = next((r for r in RULES if r[0].match(key)), None)
        if DRAWN.search(path):
            allowed = nothing + OF_DRAWS * abs(expected)
        elif key == "std":
            allowed = SHARE * abs(expected)
        elif rule is not None:
            allowed = max(nothing, rule[1]) + rule[2] * max(abs(expected), measure.size)
        elif sd:
            allowed = SHARE * sd
    if not off <= allowed:
        told = f"{off / sd:.2g} sd, allowed {allowed / sd:.2g}" if sd else ""
        told = told or f"off by {off:.3g}, allowed {allowed:.3g}"
        yield Difference(path, f"{expected:.9g}", f"{found:.9g}", told)


def _texts(path: str, expected: str, found: str, engine: bool) -> Iterator[Difference]:
    """Words must be the same, numbers close; how lines are broken and columns filled is not
    compared, since it follows from the width of numbers."""
    old, new = _words(expected), _words(found)
    matcher = difflib.SequenceMatcher(
        None, [_masked(w) for w in old], [_masked(w) for w in new], autojunk=False
    )
    for kind, a, b, c, d in matcher.get_opcodes():
        if kind != "equal":
            before = " ".join(old[max(0, a - 6) : a])
            shown = f"… {before} [{' '.join(old[a:b])}]", f"… {before} [{' '.join(new[c:d])}]"
            yield Difference(path, *shown)
            continue
        for i, j in zip(range(a, b), range(c, d), strict=True):
            if not _close(old[i], new[j], engine):
                around = " ".join(old[max(0, i - 4) : i])
                yield Difference(path, f"… {around} {old[i]}", f"… {around} {new[j]}")


def _words(text: str) -> list[str]:
    return re.sub(r"[─━]+", "─", text).split()


def _free(word: str) -> bool:
    """Whether a word is a number that may move: joint2.compliance and M1 are names."""
    return not re.search(r"[^\W\d_]\w*\d|\d+[-:]\d+", word.replace("e-", "").replace("e+", ""))


def _masked(word: str) -> str:
    return NUMBER.sub("#", word) if _free(word) else word


def _close(shown: str, printed: str, engine: bool) -> bool:
    for a, b in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        if a == b:
            continue
        decimals = len(a.partition("e")[0].partition(".")[2])
        last = 10.0**-decimals if decimals else float(engine and len(a) > 1)
        old, new = (float(x.replace("−", "-").lstrip("±+")) for x in (a, b))
        if not math.isclose(old, new, rel_tol=LOOSE if engine else EXACT, abs_tol=1.001 * last):
            return False
    return True
