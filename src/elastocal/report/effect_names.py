"""Effects in words: names, places, drivers, probabilities, settings; the catalogue as rows."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.diagnosis import SMALLEST_P, Candidate, EffectAt, FoundEffect
from elastocal.errors import InputError
from elastocal.model.arm import ParameterSpec
from elastocal.model.chain import Chain, numbered
from elastocal.model.effects.base import Effect
from elastocal.model.effects.catalogue import CATALOGUE, cell_of
from elastocal.model.manipulator import load_chain
from elastocal.report.formatting import display, significant, together, with_uncertainty
from elastocal.text import printable

# Places that are the only one their effects have: "base drift", not "base drift at base".
SINGLE = ("base", "wrist", "load", "tracker", "arm")
STAGES = {
    "transmission": "transmission",
    "geometry": "links",
    "load": "loads",
    "compliance": "compliance",
    "tool": "tool and markers",
    "tracker": "tracker",
}
LONG_TIME = 120.0  # s, from which on times are told in minutes


def plain_name(name: str) -> str:
    """ "gear_eccentricity" → "gear eccentricity"."""
    return printable(name).replace("_", " ")


def place(where: str) -> str:
    """ "joint2" → "joint 2", "marker:M_1" → "marker M_1", "all" → "all links"."""
    if where.startswith("marker:"):
        return f"marker {printable(where.removeprefix('marker:'))}"
    if where == "all":
        return "all links"
    return re.sub(r"^([a-z]+)([0-9]+)$", r"\1 \2", printable(where))


def effect_at(e: EffectAt | FoundEffect | Candidate) -> str:
    """ "gear eccentricity at joint 2", "base drift", "marker slip of marker M1"."""
    name = plain_name(e.effect)
    if e.where in SINGLE:
        return name
    of_what = e.where == "all" or e.where.startswith(("marker:", "link"))
    return f"{name} {'of' if of_what else 'at'} {place(e.where)}"


KINDS_OF_PLACE = re.compile(r"(joint|link)([0-9]+)")
# Steps of a budget that are no effects.
STEPS = {"unknown": "what has no name", "rest": "the smaller causes"}


def places(where: Iterable[str], runs: bool = False) -> str:
    """ "joints 1, 2 and 5", "link 3 and base"; with `runs` "joints 1 to 4 and 6"."""
    numbers: dict[str, list[int]] = {}
    others = []
    for one in where:
        if match := KINDS_OF_PLACE.fullmatch(one):
            numbers.setdefault(match[1], []).append(int(match[2]))
        else:
            others.append(place(one))
    counted = [
        f"{kind}{'s' * (len(found) > 1)} "
        + together(_in_runs(sorted(found)) if runs else [str(n) for n in sorted(found)])
        for kind, found in numbers.items()
    ]
    return together([*counted, *others])


def _in_runs(numbers: Sequence[int]) -> list[str]:
    """[1, 2, 3, 5] → "1 to 3", "5"; two in a row stay two."""
    found: list[list[int]] = []
    for n in numbers:
        if found and n == found[-1][-1] + 1:
            found[-1].append(n)
        else:
            found.append([n])
    short = ([f"{run[0]} to {run[-1]}"] if len(run) > 2 else map(str, run) for run in found)
    return [text for texts in short for text in texts]


def effect_at_places(effect: str, where: Sequence[str]) -> str:
    """ "gear errors at joints 1, 2 and 5", "thermal expansion of links 2 and 3"."""
    if effect not in STEPS and len(where) == 1:
        return effect_at(EffectAt(effect, where[0]))
    of_what = all(w == "all" or w.startswith(("marker:", "link")) for w in where)
    name = STEPS.get(effect, plain_name(effect))
    return f"{name} {'of' if of_what and effect not in STEPS else 'at'} {places(where)}"


def name_of(text: str) -> str:
    """A step of the budget or a rival: "base_frame", "link_bending at link2", "backlash:joint3",
    "gear_errors:joint1+joint2"."""
    effect, colon, where = text.replace(" at ", ":", 1).partition(":")
    if not colon:
        return STEPS.get(text) or driver_name(plain_name(text))
    several = where.split("+")
    # A marker may be called "M+1".
    known = all(
        KINDS_OF_PLACE.fullmatch(w) or w in ("all", *SINGLE) or w.startswith("marker:")
        for w in several
    )
    return effect_at_places(effect, several if known else [where])


def driver_name(driver: str) -> str:
    """ "joint2 angle" → "joint 2 angle"."""
    return re.sub(r"\b(joint|link)([0-9]+)\b", r"\1 \2", printable(driver))


def probability(p: float) -> str:
    """Two decimals, and never a certainty."""
    if not math.isfinite(p):
        return "–"
    if p > 0.995:
        return "> 0.99"
    return "< 0.01" if p < 0.005 else f"{p:.2f}"


def p_value(p: float) -> str:
    """Two digits, or that it is below the smallest that is told."""
    if not math.isfinite(p):
        return "–"
    return f"< {SMALLEST_P:.4f}" if p <= SMALLEST_P else significant(p, 2)


def size_of(p: float) -> str:
    """ "p = 0.02", "p < 0.0001"."""
    text = p_value(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def percent(fraction: float) -> str:
    return f"{round(100 * fraction)} %" if math.isfinite(fraction) else "none"


def reduction(f: FoundEffect) -> str:
    """ "75 % (63 to 84 %)"."""
    low, high = f.gap_reduction_ci95
    if not (math.isfinite(low) and math.isfinite(high)):
        return percent(f.gap_reduction)
    return f"{percent(f.gap_reduction)} ({round(100 * low)} to {percent(high)})"


def settings_text(settings: Mapping[str, float], lines: Sequence[float] = ()) -> str:
    """Searched constants with their units: "jump time 12.0 min, ripple order 101"; for want of
    times a moment is one between the `lines` of the table at which visits begin."""
    ends = {key: key.replace("_low_", "_high_") for key in settings if "_low_" in key}
    pairs = {low: high for low, high in ends.items() if high in settings}
    # What all names begin with says nothing.
    first = {key.partition("_")[0] + "_" for key in settings}
    begin = first.pop() if len(first) == 1 < len(settings) else ""
    texts = []
    for key, value in settings.items():
        if LINE.fullmatch(key) or key.endswith(REFERENCE):
            continue
        if lines and key.endswith("_time_s"):
            later = min((line for line in lines if line > value), default=value)
            texts.append(f"before line {later:.0f} of the table, by the order of its rows")
        elif key in pairs:
            high = setting_value(pairs[key], settings[pairs[key]])
            texts.append(f"from {setting_value(key, value)} to {high}")
        elif key not in pairs.values():
            name = plain_name(_name_and_unit(key)[0].removeprefix(begin))
            texts.append(f"{name} {setting_value(key, value)}")
    return ", ".join([*texts, *_orders(settings)])


LINE = re.compile(r"order_(sd_)?[0-9]+")  # of a spectrum: an order and how uncertain it is
REFERENCE = "_centre_rad"  # where phases count from says nothing
MOST_ORDERS = 6


def _orders(settings: Mapping[str, float]) -> list[str]:
    """ "orders 1.000 ± 0.002, 18.52 ± 0.03 and 4 more", with 95 % half widths."""
    told = []
    orders = [key for key in settings if (line := LINE.fullmatch(key)) and not line[1]]
    for key in orders[:MOST_ORDERS]:
        sd = settings.get(key.replace("_", "_sd_"), 0.0)
        value, half = with_uncertainty(settings[key], 1.96 * sd)
        told.append(f"{value} ± {half}" if sd > 0 else significant(settings[key], 4))
    if more := len(orders) - len(told):
        told.append(f"{more} more")
    return [f"order{'s' * (len(orders) > 1)} {together(told)}"] if told else []


def _name_and_unit(key: str) -> tuple[str, str]:
    name, _, unit = key.rpartition("_")
    return (name, unit) if unit in ("s", "rad") and name else (key, "")


def setting_value(key: str, value: float) -> str:
    """A searched constant in the unit of its key, "12.0 min" or "5.7°"; a size in mrad."""
    unit = _name_and_unit(key)[1]
    if unit == "rad":
        if "size" in key:
            return f"{significant(value * 1e3)} mrad"
        return f"{significant(math.degrees(value))}°"
    if unit != "s":
        return significant(value, 4)
    if abs(value) < LONG_TIME:
        return f"{significant(value)} s"
    return f"{significant(value / 60)} min"


# What can be fitted, as rows: each effect of the catalogue with its unit, size, places, words.


def effect_entries(cell: Cell | str | Path) -> list[dict[str, Any]]:
    """Per effect, in the catalogue's order: name, stage, what it is, places, parameters.

    Places and sizes are those of the cell's arm.  An effect that the cell fits is `on`.  A
    parameter's typical size is null where only the readings say it.
    """
    given = cell_of(cell)
    chain = load_chain(given)
    given = numbered(given, chain)
    on = {choice.name for choice in given.model.effects}
    return [_entry(effect, chain, given, effect.name in on) for effect in CATALOGUE.values()]


def _entry(effect: Effect, chain: Chain, cell: Cell, on: bool) -> dict[str, Any]:
    where = effect.places(chain, cell)
    parameters = _parameters(effect, where, chain, cell)
    return {
        "name": effect.name,
        "stage": effect.stage,
        "on": on or effect.acts_unasked(cell),
        "what": what_it_is(effect),
        "places": list(where),
        "needs": list(effect.needed(cell)),
        "parameters": [
            {"key": p.key, "unit": p.unit, "nominal": p.nominal, "typical": p.typical}
            for p in parameters
        ],
    }


def _parameters(
    effect: Effect, where: tuple[str, ...], chain: Chain, cell: Cell
) -> tuple[ParameterSpec, ...]:
    """Those at its first place; none where settings of the cell make them."""
    try:
        return effect.parameters(where[0], chain, cell) if where else ()
    except InputError:  # link weights without masses
        return ()


def what_it_is(effect: Effect) -> str:
    """The first paragraph of the effect's own text, on one line."""
    first = inspect.cleandoc(type(effect).__doc__ or "").split("\n\n")[0]
    return " ".join(first.split())


def effect_head(entry: dict[str, Any]) -> str:
    """Name (* where it is on), places and sizes of an effect, for people."""
    where = places(entry["places"], runs=True) or "nowhere here"
    return f"{entry['name']}{' *' * entry['on']}: {where}; {_sizes(entry['parameters'])}"


def _sizes(parameters: list[dict[str, Any]]) -> str:
    """The typical sizes in each unit: "3 mm, 3 mrad", "0.004 to 0.1 mrad"."""
    sizes: dict[str, list[float]] = {}
    for p in parameters:
        value, unit = display(p["typical"] or 0.0, p["unit"])
        sizes.setdefault(unit, []).append(float(f"{value:.2g}"))
    told = []
    for unit, found in sizes.items():
        ends = dict.fromkeys(f"{v:g}" for v in (min(found), max(found)))
        told.append(f"{' to '.join(ends)} {unit}" if max(found) else f"{unit}, as the readings say")
    return ", ".join(told) or "no size of its own"
