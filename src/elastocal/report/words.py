"""What a result says, in words: shared by the terminal and the page."""

from __future__ import annotations

from elastocal.identification.result import (
    Calibration,
    Combination,
    Estimate,
    deviation,
)
from elastocal.report.units import significant

# How a parameter stands, in the order in which they are told.
ALONE, COMBINED, ABSORBED, INVISIBLE, FIXED = "alone", "combined", "absorbed", "invisible", "fixed"
LARGEST_TERMS = 4

Truth = dict[str, float]


def printable(text: str) -> str:
    """Names from files may hold control characters, which a terminal would obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def short_name(name: str, most: int = 12) -> str:
    """A printable name that fits a figure's axis."""
    text = printable(name)
    return text if len(text) <= most else text[: most - 1] + "…"


def standings(result: Calibration) -> dict[str, str]:
    """Parameter name → ALONE, COMBINED (first of a combination), ABSORBED, INVISIBLE or FIXED."""
    first = {next(iter(c.terms)) for c in result.combinations}

    def standing(e: Estimate) -> str:
        if e.identifiable:
            return ALONE
        if e.name in first:
            return COMBINED
        if e.combined_with:
            return ABSORBED
        return FIXED if e.note.startswith("fixed") else INVISIBLE

    return {e.name: standing(e) for e in result.estimates}


def names_of(result: Calibration, standing: str) -> list[str]:
    return [printable(name) for name, s in standings(result).items() if s == standing]


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


def short_note(result: Calibration, e: Estimate) -> str:
    """Why a parameter has no number of its own, in a few words; empty where it has one."""
    standing = standings(result)[e.name]
    if standing == COMBINED:
        return f"only as {shortened(result.combination(e.name))}"
    if standing == ABSORBED:
        several = len(e.combined_with) - 3
        names = ", ".join(printable(n) for n in e.combined_with[:3])
        return f"held: absorbed in {names}" + (f" + {several} more" if several > 0 else "")
    if standing == INVISIBLE:
        return "held: not visible in these data"
    return "fixed by the user" if standing == FIXED else printable(e.note)


def held_where(result: Calibration, names: list[str]) -> str:
    """Where all of `names` are held: at nominal, or at a start value that is none."""
    chosen = [e for e in result.estimates if printable(e.name) in names]
    at_nominal = all(e.held == e.nominal and nominal_known(result, e.name) for e in chosen)
    return "held at nominal" if at_nominal else "held at the start value"


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
    found = [inside(truth.get(e.name), e.ci95) for e in result.estimates]
    found += [inside(combination_truth(result, c, truth), c.ci95) for c in result.combinations]
    return found.count("inside"), len(found) - found.count("")


def nominal_known(result: Calibration, name: str) -> bool:
    """False for a zero that only stands for "no nominal value stated", as of a compliance."""
    parameter = result.model.parameters[result.model.names.index(name)]
    return parameter.nominal != 0 or parameter.typical is not None


def undetermined_lines(result: Calibration) -> list[str]:
    """Which parameters have no number of their own, and why, one line per reason."""
    lines = []
    if names := names_of(result, INVISIBLE):
        where = held_where(result, names)
        lines.append(f"{where} (not visible in these data): {', '.join(names)}")
    if names := names_of(result, ABSORBED):
        where = held_where(result, names)
        lines.append(f"{where}, absorbed in a combination: {', '.join(names)}")
    if names := names_of(result, FIXED):
        lines.append(f"fixed by the user: {', '.join(names)}")
    return lines
