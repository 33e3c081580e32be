"""Numbers, names and tables as text: the units people think in, the digits that are known."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

from elastocal.report.blocks import Sentence, ShownTable
from elastocal.text import printable
from elastocal.units import Array

if TYPE_CHECKING:
    from elastocal.planning.plan import Plan

# SI unit → (factor, unit shown).
SHOWN = {
    "m": (1e3, "mm"),
    "rad": (1e3, "mrad"),
    "1": (1e6, "ppm"),
    "rad/(N*m)": (1e6, "µrad/(N·m)"),
    "m/N": (1e6, "µm/N"),
    "N/m": (1e-3, "N/mm"),
    "N*m/rad": (1e-3, "kN·m/rad"),
    "N": (1.0, "N"),
    "kg": (1.0, "kg"),
    "m/s": (3.6e9, "µm/h"),
    "rad/s": (3.6e9, "µrad/h"),
    "1/K": (1e6, "ppm/K"),
}
MOST_DECIMALS = 9


def display(value: float, unit: str) -> tuple[float, str]:
    """`value` in SI `unit` as people read it: 2.87e-7, "rad/(N*m)" → 0.287, "µrad/(N·m)".

    A unit that is not listed keeps its value, written with proper symbols.
    """
    if unit in SHOWN:
        factor, text = SHOWN[unit]
        return value * factor, text
    return value, unit.replace("*", "·").replace("^2", "²").replace("^3", "³")


def with_uncertainty(value: float, half: float) -> tuple[str, str]:
    """Value and ± half width with the digits the half width allows: "0.287", "0.003".

    The half width gets two digits where it begins with 1 or 2, else one; hundreds and more
    are rounded off as well.
    """
    if not (math.isfinite(value) and math.isfinite(half)) or half <= 0:
        return plain(value), plain(half)
    exponent = math.floor(math.log10(half))
    digits = 2 if half / 10.0**exponent < 2.95 else 1
    decimals = digits - 1 - exponent
    if decimals > MOST_DECIMALS:
        size = math.floor(math.log10(abs(value))) if value else exponent
        return f"{value:.{min(max(size + decimals, 0), 15)}e}", f"{half:.{digits - 1}e}"
    shown = max(decimals, 0)
    return f"{_round(value, decimals):.{shown}f}", f"{_round(half, decimals):.{shown}f}"


def estimate(value: float, half: float, unit: str) -> tuple[str, str, str]:
    """SI value and half width as text: value, ± half width, unit."""
    shown, text = display(value, unit)
    return *with_uncertainty(shown, display(half, unit)[0]), text


def with_ends(value: float, low: float, high: float) -> tuple[str, str]:
    """Value and interval with the digits that `resolution` allows: "0.000", "[0.000, 0.013]"."""
    size = resolution(value, low, high)
    return rounded_alike(value, size), f"[{_end(low, size)}, {_end(high, size)}]"


def resolution(value: float, low: float, high: float) -> float:
    """The half width whose digits a lopsided interval is shown with, 0 where both ends are open.

    Its shorter side gets two digits, unless that is empty, without an end, or below a tenth of
    the longer.
    """
    sides = [side for side in (value - low, high - value) if 0 < side < math.inf]
    if not sides:
        return 0.0
    return 1.5 * 10.0 ** math.floor(math.log10(max(min(sides), max(sides) / 10)))


def rounded_alike(value: float, half: float) -> str:
    """`value` with the digits that `half` allows: a true value beside its estimate."""
    return with_uncertainty(value, half)[0]


def plain(value: float) -> str:
    """A number without known uncertainty, such as a nominal value: at most six digits."""
    if not math.isfinite(value):
        return "–"
    return f"{value + 0.0:.6g}"


def significant(value: float, digits: int = 3) -> str:
    """A finite number rounded to `digits` digits, without an exponent where it is readable."""
    if value == 0 or not 1e-5 < abs(value) < 1e7:
        return f"{value:.{digits}g}"
    decimals = digits - 1 - math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    return f"{_round(value, decimals):.{max(decimals, 0)}f}"


def length(metres: float) -> str:
    """A position error: µm below 1 mm, mm below 1 m, "not available" where there is no number."""
    if not math.isfinite(metres):
        return "not available"
    if abs(metres) < 0.9995e-3:
        return f"{significant(metres * 1e6)} µm"
    if abs(metres) < 0.9995:
        return f"{significant(metres * 1e3)} mm"
    return f"{significant(metres)} m"


def newtons(force: Iterable[float]) -> str:
    """ "(0, 0, -2600) N"."""
    return f"({', '.join(f'{v + 0.0:g}' for v in force)}) N"


def load_text(force: Iterable[float]) -> str:
    return newtons(force) if any(force) else "unloaded"


def loads_text(forces: Array, one: str, several: str) -> str:
    """Forces in the words for `one` of them, or for their number and how large they are."""
    if len(forces) == 1:
        return one.format(newtons(forces[0]))
    sizes = [math.hypot(*force) for force in forces]
    return f"{several.format(len(sizes))}, {min(sizes):.4g} to {max(sizes):.4g} N"


def _end(value: float, half: float) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return rounded_alike(value, half)


def _round(value: float, decimals: int) -> float:
    """Rounded, and never -0."""
    return round(value, decimals) + 0.0


def short_name(name: str, most: int = 12) -> str:
    """A printable name that fits a figure's axis."""
    text = printable(name)
    return text if len(text) <= most else text[: most - 1] + "…"


def counted(n: int, one: str, many: str | None = None) -> str:
    """ "1 pose", "2 poses"."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'}{significant(abs(value))}"


def signed_change(metres: float) -> str:
    return f"{'-' if metres < 0 else '+'}{length(abs(metres))}"


MINUS = re.compile(r"(?<![\w.)\]-])-(?=[\d.∞])|(?<= )-(?= )")


def typeset(text: str) -> str:
    """With proper minus signs before numbers and between terms, not in names."""
    return MINUS.sub("−", text)


def together(parts: Sequence[str], last: str = "and") -> str:
    """ "a, b and c"."""
    return f" {last} ".join([p for p in (", ".join(parts[:-1]), *parts[-1:]) if p])


def capital(text: str) -> str:
    """As a sentence begins; a symbol such as p or ρ₀ stays as it is."""
    return text if text[1:2] in (" ", "₀") else f"{text[:1].upper()}{text[1:]}"


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    return f"{capital(text.rstrip('.'))}."


def title_of(*names: str) -> str:
    """Robot and cell, once where they have the same name."""
    return printable(" – ".join(name for name in dict.fromkeys(names) if name))


MOST_FAULTY = 100  # rows of the table of outliers


def outlier_blocks(
    title: str, found: Sequence[tuple[Any, float, float]]
) -> list[ShownTable | Sentence]:
    """Readings beyond the noise: each with its line and names, its error in m, and that over the
    noise."""
    rows = [
        (str(o.line), printable(o.configuration), printable(o.marker), length(error),
         significant(ratio))
        for o, error, ratio in found[:MOST_FAULTY]
    ]  # fmt: skip
    heads = ("line", "configuration", "marker", "error", "error / noise")
    more = len(found) - len(rows)
    blocks: list[ShownTable | Sentence] = [ShownTable(heads, rows, (1, 2), title=title)]
    return [*blocks, Sentence(f"and {more} more", soft=True)] if more else blocks


def budget_table(
    steps: Sequence[tuple[str, float, tuple[float, float]]], floor: tuple[str, float] | None
) -> ShownTable:
    """Steps (name, held-out rms in m, its 95 % interval) and what each changes; `floor` last."""
    rows: list[tuple[str, ...]] = []
    for k, (name, rms, ci95) in enumerate(steps):
        change = signed_change(rms - steps[k - 1][1]) if k else ""
        rows.append((name, length(rms), " to ".join(map(length, ci95)), change))
    if floor is not None:
        rows.append((floor[0], length(floor[1]), "", ""))
    heads = ("model", "held-out rms", "95 %", "change")
    return ShownTable(heads, rows, title="Error budget (3-D rms error at held-out poses)")


def joint_heads(kinds: Sequence[str]) -> list[str]:
    return [f"q{i + 1} {'°' if kind == 'revolute' else 'mm'}" for i, kind in enumerate(kinds)]


def joint_texts(q: Iterable[float], kinds: Sequence[str], decimals: int = 2) -> list[str]:
    """Joints q (n,) in rad or m as texts in ° or mm."""
    return [
        f"{math.degrees(v) if kind == 'revolute' else v * 1e3:.{decimals}f}"
        for v, kind in zip(q, kinds, strict=True)
    ]


def first_stops(plan: Plan) -> dict[int, int]:
    """Pose → its first place in the order of execution, from 1."""
    stops = reversed(list(enumerate(plan.execution.stops)))
    return {stop.pose: k + 1 for k, stop in stops if not stop.again}


def resource(name: str) -> str:
    """The text of a file beside this module."""
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")
