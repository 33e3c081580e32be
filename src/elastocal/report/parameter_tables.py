"""The parameters of an identification as tables, and why some have no value of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from elastocal.identification.findings import (
    ABSORBED,
    COMBINED,
    FIXED,
    INVISIBLE,
    WEAK,
    standings,
)
from elastocal.identification.result import (
    LOPSIDED,
    Calibration,
    Combination,
    Estimate,
    deviation,
)
from elastocal.report.blocks import Bar, ShownTable
from elastocal.report.formatting import (
    display,
    estimate,
    plain,
    resolution,
    rounded_alike,
    significant,
    with_ends,
)
from elastocal.text import listed, printable

LARGEST_TERMS = 4
Truth = dict[str, float]
Published = Mapping[str, tuple[float, float]]


def names_of(result: Calibration, standing: str) -> list[str]:
    found = standings(result)
    return [printable(e.name) for e in result.ordinary if found[e.name] == standing]


def shortened(combination: Combination, most: int = LARGEST_TERMS) -> str:
    """The first member and the largest other terms by factor, "+ n more" for the rest."""
    (first, _), *rest = combination.terms.items()
    kept = sorted(rest, key=lambda term: -abs(term[1]))[: most - 1]
    text = printable(first)
    for name, factor in [term for term in rest if term in kept]:
        size = significant(abs(factor))
        number = "" if float(size) == 1 else f"{size}·"
        member = deviation(printable(name), combination.held.get(name), 4)
        text += f" {'-' if factor < 0 else '+'} {number}{member}"
    more = len(rest) - len(kept)
    return f"{text} + {more} more" if more else text


def why_without(result: Calibration, e: Estimate) -> str:
    """Why a parameter has no number of its own, in a few words; else what is noted of it."""
    standing = standings(result)[e.name]
    if standing == COMBINED:
        return f"only as {shortened(result.combination(e.name))}"
    if standing == ABSORBED:
        several = len(e.combined_with) - 3
        names = ", ".join(printable(n) for n in e.combined_with[:3])
        return f"held: absorbed in {names}" + (f" + {several} more" if several > 0 else "")
    if standing == WEAK:
        return f"hardly shown: {limits(result, e)}"
    if standing == INVISIBLE:
        return "held: not visible in these data"
    return "fixed by the user" if standing == FIXED else printable(e.note)


def limits(result: Calibration, e: Estimate) -> str:
    """What the readings say of a parameter that they hardly show, and what the model uses."""
    assert e.limits is not None
    p = result.model.parameters[result.model.names.index(e.name)]
    low, high = (significant(display(end, e.unit)[0], 2) for end in e.limits)
    held, unit = display(e.held, e.unit)
    text = f"{low} to {high} {unit}"
    if e.limits[0] <= p.lower <= e.limits[1]:
        text = f"at most {high} {unit}"
    elif e.limits[0] <= p.upper <= e.limits[1]:
        text = f"at least {low} {unit}"
    used = "nominal" if e.held == e.nominal and e.held else significant(held, 2)
    return f"{text}; {used} is used"


def combination_truth(result: Calibration, combination: Combination, truth: Truth) -> float | None:
    """True value X_k + Σ f·(X_d − held_d), None where a member's true value is not known."""
    (first, _), *rest = combination.terms.items()
    if any(name not in truth for name in combination.terms):
        return None
    shift = sum(f * (truth[name] - result[name].held) for name, f in rest)
    return truth[first] + shift


def inside(value: float | None, ci95: tuple[float, float] | None) -> str:
    """Whether a true value lies in the 95 % interval; empty where either is unknown."""
    if value is None or ci95 is None:
        return ""
    return "inside" if ci95[0] <= value <= ci95[1] else "outside"


def coverage(result: Calibration, truth: Truth) -> tuple[int, int]:
    """How many 95 % intervals hold the true value, of how many that could be compared."""
    found = [inside(truth.get(e.name), e.ci95) for e in result.ordinary]
    found += [inside(combination_truth(result, c, truth), c.ci95) for c in result.combinations]
    return found.count("inside"), len(found) - found.count("")


def nominal_known(result: Calibration, name: str) -> bool:
    """False for a zero that only stands for "no nominal value stated", as of a compliance."""
    parameter = result.model.parameters[result.model.names.index(name)]
    return parameter.nominal != 0 or parameter.typical is not None


def undetermined_lines(result: Calibration, most: int | None = None) -> list[str]:
    """Which parameters have no number of their own, and why, one line per reason; `most` names."""
    weak = [
        f"{printable(e.name)} ({limits(result, e)})"
        for e in result.ordinary
        if e.limits is not None
    ]
    invisible, absorbed, fixed = (names_of(result, s) for s in (INVISIBLE, ABSORBED, FIXED))
    extra = {printable(name) for name in result.left.redundant} if result.left else set()
    held = {
        " (not visible in these data)": [n for n in invisible if n not in extra],
        ", absorbed in a combination": [n for n in absorbed if n not in extra],
        ", not identifiable with these loads (expected)": [
            n for n in (*invisible, *absorbed) if n in extra
        ],
    }
    found = {"hardly shown, so without a value (95 %)": weak}
    found |= {f"{_held_where(result, names)}{why}": names for why, names in held.items()}
    found["fixed by the user"] = fixed
    return [f"{why}: {listed(n, most or len(n))}" for why, n in found.items() if n]


def _held_where(result: Calibration, names: list[str]) -> str:
    """Where all of `names` are held: at nominal, or at a start value that is none."""
    chosen = [e for e in result.estimates if printable(e.name) in names]
    at_nominal = all(e.held == e.nominal and nominal_known(result, e.name) for e in chosen)
    return "held at nominal" if at_nominal else "held at the start value"


def texts(e: Estimate | Combination, true: float | None) -> tuple[str, str, str, str]:
    """Value, half width or both ends, unit and true value; "–" for what is not determined."""
    if e.value is None or e.ci95 is None:
        known = "–" if true is None else plain(display(true, e.unit)[0])
        return "–", "–", display(0.0, e.unit)[1], known
    if is_lopsided(e.value, e.ci95):
        shown, low, high = (display(number, e.unit)[0] for number in (e.value, *e.ci95))
        value, half = with_ends(shown, low, high)
        width, unit = resolution(shown, low, high), display(e.value, e.unit)[1]
    else:
        width = (e.ci95[1] - e.ci95[0]) / 2
        value, half, unit = estimate(e.value, width, e.unit)
        width = display(width, e.unit)[0]
    known = "–" if true is None else rounded_alike(display(true, e.unit)[0], width)
    return value, half, unit, known


def is_lopsided(value: float, ci95: tuple[float, float]) -> bool:
    """Whether the interval needs both ends to be told: not symmetric, or without an end."""
    below, above = value - ci95[0], ci95[1] - value
    if not (math.isfinite(below) and math.isfinite(above)):
        return True
    return abs(above - below) > max(LOPSIDED * max(above, below), ROUNDING * abs(value))


TRUTH_REACH = 2.5  # half widths from the true value to a bar's end
ROUNDING = 1e-9  # sides of an interval this short beside the value are alike


def bar(value: float, ci95: tuple[float, float], reference: float, alike: bool) -> Bar | None:
    """The interval beside the reference; None where nothing has an end.

    `alike`: as long as the bars of all others, so that one sees how many half widths the reference
    is away; else on a scale of its own, which shows all.  An open end reaches the end of the bar.
    """
    far = [abs(x - reference) for x in (value, *ci95) if math.isfinite(x)]
    sides = [side for side in (value - ci95[0], ci95[1] - value) if math.isfinite(side)]
    half = (ci95[1] - ci95[0]) / 2 if len(sides) == 2 else max(sides, default=0.0)
    reach = TRUTH_REACH * half if alike else 1.05 * max(far, default=0.0)
    if not reach > 0 or not sides:
        return None
    low, high, middle = (min(max((x - reference) / reach, -1.0), 1.0) for x in (*ci95, value))
    return Bar(low, high, middle)


def parameter_table(
    result: Calibration, truth: Truth | None = None, published: Published | None = None
) -> ShownTable:
    """The parameters identified alone, by effect; `published`: what others found (SI)."""
    own = [e for e in result.ordinary if e.identifiable]
    effects = {p.name: p.effect.replace("_", " ") for p in result.model.parameters}
    known = [nominal_known(result, e.name) for e in own]
    shown = [plain(display(e.nominal, e.unit)[0]) for e in own]
    after = {"nominal": [n if k else "–" for n, k in zip(shown, known, strict=True)]}
    if published:
        given = [(published.get(e.name), e.unit) for e in own]
        after["published"] = ["–" if v is None else " ± ".join(estimate(*v, unit)[:2])
                              for v, unit in given]  # fmt: skip
    if any(e.note for e in own):
        after["note"] = [printable(e.note) for e in own]
    true = None if truth is None else [truth.get(e.name) for e in own]
    nominal = [e.nominal if k else None for e, k in zip(own, known, strict=True)]
    table = _numbers("Parameters", [printable(e.name) for e in own], own, true, nominal, after)
    of = [effects[e.name] for e in own]
    groups = {k: name for k, name in enumerate(of) if not k or name != of[k - 1]}
    return replace(table, groups=groups)


def combination_table(result: Calibration, truth: Truth | None = None) -> ShownTable:
    """Sums of parameters that the data determine although their members they do not."""
    found = result.combinations
    true = None if truth is None else [combination_truth(result, c, truth) for c in found]
    title = "Combinations (factors in SI units)"
    return _numbers(title, [*map(shortened, found)], found, true, [None] * len(found), {})


def _numbers(
    title: str, names: list[str], found: Sequence[Estimate | Combination],
    truth: list[float | None] | None, nominal: list[float | None], after: dict[str, list[str]],
) -> ShownTable:  # fmt: skip
    """Names, values, intervals and units, with true values where known, and columns `after`.

    Bars show the interval beside the true value, else beside the nominal one.
    """
    lopsided = any(
        e.value is not None and e.ci95 is not None and is_lopsided(e.value, e.ci95) for e in found
    )
    first, half = title.split()[0].lower().removesuffix("s"), "95 %" if lopsided else "± 95 %"
    of_truth = ["truth", "in 95 %"] if truth else []
    heads = (first, "value", half, "unit", *of_truth, *after)
    rows, bars, brief = [], [], []
    for k, e in enumerate(found):
        at = truth[k] if truth else nominal[k]
        value, width, unit, known = texts(e, at if truth else None)
        signed = width if width.startswith(("[", "–")) else f"± {width}"
        held = [inside(at, e.ci95)] if truth else []
        rest = [*([known, *held] if truth else []), *(own[k] for own in after.values())]
        rows.append((names[k], value, signed if lopsided else width, unit, *rest))
        brief.append((names[k], f"{value} {signed} {unit}", *held))
        drawn = None
        if at is not None and e.value is not None and e.ci95 is not None:
            drawn = bar(e.value, e.ci95, at, bool(truth))
        bars.append(drawn)
    words = tuple(k for k, head in enumerate(heads) if head in (first, "unit", "in 95 %", "note"))
    narrow = ShownTable((first, f"value {half}", *of_truth[1:]), brief, (0, 1, 2), title=title)
    note = "Bars are 95 % intervals beside the nominal value (upright line), each on its own scale."
    if truth:
        note = "Bars are 95 % intervals around the true value (upright line), all equally wide."
    shown = ShownTable(heads, rows, words, title=title, narrow=narrow)
    return replace(shown, bars=bars, of_bars=note) if any(bars) else shown


def undetermined_table(result: Calibration, truth: Truth | None = None) -> ShownTable:
    """Every parameter without a value of its own, and why."""
    heads = ["parameter", "nominal", "unit", *(["truth"] if truth else []), "why"]
    rows = []
    for e in result.ordinary:
        if e.identifiable:
            continue
        nominal = plain(display(e.nominal, e.unit)[0]) if nominal_known(result, e.name) else "–"
        known = [texts(e, truth.get(e.name))[3]] if truth else []
        unit = display(0.0, e.unit)[1]
        rows.append((printable(e.name), nominal, unit, *known, why_without(result, e)))
    return ShownTable(tuple(heads), rows, (0, 2, len(heads) - 1))
