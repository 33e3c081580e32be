"""What a result says as a list of blocks, made once and shown by terminal, page and notebook;
numbers, names and effects as text.

Texts are plain: a renderer escapes them, typesets minus signs and decides on the layout.  Numbers
have the units people think in and the digits that are known.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal

from elastocal.measurements import in_file_units
from elastocal.messages import counted as counted
from elastocal.messages import length, newtons, printable, rounded, significant, together
from elastocal.messages import p_value as p_value
from elastocal.messages import size_of as size_of
from elastocal.model.manipulator import Model
from elastocal.units import Array, display

if TYPE_CHECKING:
    from elastocal.diagnosis.diagnosis import Candidate, EffectAt, FoundEffect
    from elastocal.planning.plan import Plan

# good: use it; warn: use it knowing what is wrong, or look what changed; poor: do not use it.
Tone = Literal["good", "warn", "poor"]
TONES: dict[str, Tone] = {"good": "good", "note": "good", "care": "warn", "poor": "poor"}


@dataclass(frozen=True)
class ShownVerdict:
    tone: Tone
    sentence: str


@dataclass(frozen=True)
class KeyFigures:
    """What came out in one line of numbers, and the four that count (what it is, number); a
    terminal has both in sentences."""

    headline: str
    figures: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Heading:
    text: str


@dataclass(frozen=True)
class Sentence:
    """A sentence; `soft`: an explanation, which stands back."""

    text: str
    soft: bool = False


class Lines:
    """Sentences with labels, those that there are; labels WARNING call for attention."""

    def __init__(self, items: Iterable[tuple[str, str | None]]) -> None:
        self.items = [(label, text) for label, text in items if text]


WARNING = "Warning"


@dataclass(frozen=True)
class ShownTable:
    """`words` are the columns that hold words; the others hold numbers.  `groups` names the rows
    that follow, by the index of the first: {0: "base frame", 6: …}, for a page.  `narrow` is the
    same with less, for a terminal that is too narrow."""

    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: tuple[int, ...] = (0,)
    groups: dict[int, str] = field(default_factory=dict)
    title: str = ""
    note: str = ""
    narrow: ShownTable | None = None

    def without(self, *columns: int) -> ShownTable:
        kept = [k for k in range(len(self.heads)) if k not in columns]
        heads, *rows = (tuple(row[k] for k in kept) for row in (self.heads, *self.rows))
        words = tuple(n for n, k in enumerate(kept) if k in self.words)
        return replace(self, heads=heads, rows=rows, words=words, narrow=None)

    def when_narrow(self, *columns: int) -> ShownTable:
        """Some columns are lost where there is no room for them."""
        return replace(self, narrow=self.without(*columns))


@dataclass(frozen=True)
class Figure:
    """What `draw` puts on matplotlib's figure, `height` inches high.  `name` is what `plot` calls
    it, `title` says what it shows to those who cannot see it.  With a `space` (arm_view.Space) it
    is the arm, which a page lets be turned."""

    name: str
    title: str
    draw: Callable[[Any], None]
    height: float
    caption: str = ""
    space: Any = None


@dataclass(frozen=True)
class Fold:
    """What stands behind a summary, or without one open on pages; made only when it is shown.
    `printed`: by a terminal too, with details.  `figures` are the names of those it may have."""

    summary: str
    blocks: Callable[[], Iterable[Block]]
    printed: bool = False
    figures: tuple[str, ...] = ()


Block = ShownVerdict | KeyFigures | Heading | Sentence | Lines | ShownTable | Figure | Fold


def unfolded(blocks: Iterable[Block], which: Callable[[Fold], bool]) -> Iterator[Block]:
    """All blocks, and in the place of each fold its summary as heading and what it holds."""
    for block in blocks:
        if not isinstance(block, Fold):
            yield block
        elif which(block):
            yield Heading(block.summary)
            yield from unfolded(block.blocks(), which)


MOST_DECIMALS = 9


def with_uncertainty(value: float, half: float) -> tuple[str, str]:
    """ "0.287", "0.003": the half width gets two digits where it begins with 1 or 2, else one;
    hundreds and more are rounded off as well, and nothing is -0."""
    if not (math.isfinite(value) and math.isfinite(half)) or half <= 0:
        return plain(value), plain(half)
    exponent = math.floor(math.log10(half))
    digits = 2 if half / 10.0**exponent < 2.95 else 1
    decimals = digits - 1 - exponent
    if decimals > MOST_DECIMALS:
        size = math.floor(math.log10(abs(value))) if value else exponent
        return f"{value:.{min(max(size + decimals, 0), 15)}e}", f"{half:.{digits - 1}e}"
    value, half = (round(v, decimals) + 0.0 for v in (value, half))
    return f"{value:.{max(decimals, 0)}f}", f"{half:.{max(decimals, 0)}f}"


def estimate(value: float, half: float, unit: str) -> tuple[str, str, str]:
    """SI value and half width as text: value, ± half width, unit."""
    shown, text = display(value, unit)
    return *with_uncertainty(shown, display(half, unit)[0]), text


def with_ends(value: float, low: float, high: float) -> tuple[str, str, float]:
    """Value, interval, as "0.000", "[0.000, 0.013]", and the half width whose digits both have. The
    interval's shorter side gets two digits, unless that is empty, without an end, or below a tenth
    of the longer; the half width is 0 where both ends are open."""
    sides, half = [side for side in (value - low, high - value) if 0 < side < math.inf], 0.0
    if sides:
        half = 1.5 * 10.0 ** math.floor(math.log10(max(min(sides), max(sides) / 10)))
    shown, *ends = (
        "∞" if v == math.inf else "-∞" if v == -math.inf else with_uncertainty(v, half)[0]
        for v in (value, low, high)
    )
    return shown, f"[{', '.join(ends)}]", half


def plain(value: float) -> str:
    """A number without known uncertainty, such as a nominal value: at most six digits."""
    return rounded(value, 6) if math.isfinite(value) else "–"


def loads_text(forces: Array, one: str, several: str) -> str:
    """Forces in the words for `one` of them, or for their number and how large they are."""
    if len(forces) == 1:
        return one.format(newtons(forces[0]))
    ends = (rounded(pick(math.hypot(*force) for force in forces), 4) for pick in (min, max))
    return f"{several.format(len(forces))}, {' to '.join(ends)} N"


def short_name(name: str, most: int = 12) -> str:
    text = printable(name)
    return text if len(text) <= most else text[: most - 1] + "…"


def signed(value: float, told: Callable[[float], str] = significant) -> str:
    return f"{'-' if value < 0 else '+'}{told(abs(value))}"


MINUS = re.compile(r"(?<![\w.)\]-])-(?=[\d.∞])|(?<= )-(?= )")


def typeset(text: str) -> str:
    """With proper minus signs before numbers and between terms, not in names."""
    return MINUS.sub("−", text)


def capital(text: str) -> str:
    """As a sentence begins; symbols, files and parameters (p, ρ₀, data.csv) stay as they are."""
    named = re.match(r"\S(\s|₀|$)|\S*([\d_]|[./]\w)", text)
    return text if named else f"{text[:1].upper()}{text[1:]}"


def sentence(text: str) -> str:
    return f"{capital(text.rstrip('.'))}."


MOST_FAULTY = 100  # rows of the table of outliers


def outlier_blocks(title: str, found: Sequence[tuple[Any, float, float]]) -> Iterator[Block]:
    """Each with its line and names, its error in m, and that over the noise."""
    rows = [
        (str(o.line), printable(o.configuration), printable(o.marker), length(error),
         significant(ratio))
        for o, error, ratio in found[:MOST_FAULTY]
    ]  # fmt: skip
    heads = ("line", "configuration", "marker", "error", "error / noise")
    yield ShownTable(heads, rows, (1, 2), title=title)
    if more := len(found) - len(rows):
        yield Sentence(f"and {more} more", soft=True)


# Steps (name, held-out rms in m, its 95 % interval), and name and size of what noise leaves.
Steps = Sequence[tuple[str, float, tuple[float, float]]]
Floor = tuple[str, float] | None
Budget = tuple[Steps, Floor, str]


def of_distances(model: Model | None) -> bool:
    return model is not None and model.observe == "distance"


def rms(model: Model | None) -> str:
    return "rms" if of_distances(model) else "3-D rms"


def budget_table(steps: Steps, floor: Floor, of: str) -> ShownTable:
    """Steps and what each changes; `floor` last; `of`: which rms."""
    rows: list[tuple[str, ...]] = []
    for k, (name, rms, ci95) in enumerate(steps):
        change = signed(rms - steps[k - 1][1], length) if k else ""
        rows.append((name, length(rms), " to ".join(map(length, ci95)), change))
    if floor is not None:
        rows.append((floor[0], length(floor[1]), "", ""))
    heads = ("model", "held-out rms", "95 %", "change")
    return ShownTable(heads, rows, title=f"Error budget ({of} error at held-out poses)")


def joint_heads(kinds: Sequence[str]) -> list[str]:
    return [f"q{i + 1} {'°' if kind == 'revolute' else 'mm'}" for i, kind in enumerate(kinds)]


def joint_texts(q: Array, kinds: Sequence[str], decimals: int = 2) -> list[str]:
    """Joints q (n,) in rad or m as texts in ° or mm."""
    return [f"{v:.{decimals}f}" for v in in_file_units(q, kinds)]


def first_stops(plan: Plan) -> dict[int, int]:
    """Pose → its first place in the order of execution, from 1."""
    stops = reversed(list(enumerate(plan.execution.stops)))
    return {stop.pose: k + 1 for k, stop in stops if not stop.again}


def resource(name: str) -> str:
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")


# Places that are the only one their effects have: "base drift", not "base drift at base".
SINGLE = ("base", "wrist", "load", "tracker", "arm", "tool")
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
    return printable(name).replace("_", " ")


def place(where: str) -> str:
    if where.startswith("marker:"):
        return f"marker {printable(where.removeprefix('marker:'))}"
    if where == "all":
        return "all links"
    return re.sub(r"^([a-z]+)([0-9]+)$", r"\1 \2", printable(where))


def effect_at(e: EffectAt | FoundEffect | Candidate) -> str:
    return effect_at_places(e.effect, [e.where])


KINDS_OF_PLACE = re.compile(r"(joint|link)([0-9]+)")
# Steps of a budget that are no effects.
STEPS = {"unknown": "what has no name", "rest": "the smaller causes"}


def places(where: Iterable[str], runs: bool = False) -> str:
    numbers: dict[str, list[int]] = {}
    others = []
    for one in where:
        if match := KINDS_OF_PLACE.fullmatch(one):
            numbers.setdefault(match[1], []).append(int(match[2]))
        else:
            others.append(place(one))
    told = []
    for kind, found in numbers.items():
        texts: list[str] = []
        # Numbers that follow each other have the same distance from their index.
        for _, run in groupby(enumerate(sorted(found)), lambda at: at[1] - at[0]):
            first, *more = (str(n) for _, n in run)
            short = runs and len(more) > 1
            texts += [f"{first} to {more[-1]}"] if short else [first, *more]
        told.append(f"{kind}{'s' * (len(found) > 1)} {together(texts)}")
    return together([*told, *others])


def effect_at_places(effect: str, where: Sequence[str]) -> str:
    name = STEPS.get(effect, plain_name(effect))
    if effect not in STEPS and len(where) == 1 and where[0] in SINGLE:
        return name
    of_what = all(w == "all" or w.startswith(("marker:", "link")) for w in where)
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
    return re.sub(r"\b(joint|link)([0-9]+)\b", r"\1 \2", printable(driver))


def probability(p: float) -> str:
    """Two decimals, and never a certainty."""
    if not math.isfinite(p):
        return "–"
    if p > 0.995:
        return "> 0.99"
    return "< 0.01" if p < 0.005 else f"{p:.2f}"


def settings_text(settings: Mapping[str, float], lines: Sequence[float] = ()) -> str:
    """Searched constants with their units: "jump time 12.0 min, ripple order 101"; for want of
    times a moment is one between the `lines` of the table at which visits begin."""
    # What all names begin with says nothing.
    first = {key.partition("_")[0] + "_" for key in settings}
    begin = first.pop() if len(first) == 1 < len(settings) else ""
    texts = []
    for key, value in settings.items():
        low, high = key.replace("_high_", "_low_"), key.replace("_low_", "_high_")
        if LINE.fullmatch(key) or key.endswith(REFERENCE) or (low != key and low in settings):
            continue
        if lines and key.endswith("_time_s"):
            later = min((line for line in lines if line > value), default=value)
            texts.append(f"before line {later:.0f} of the table, by the order of its rows")
        elif high != key and high in settings:
            end = setting_value(high, settings[high])
            texts.append(f"from {setting_value(key, value)} to {end}")
        else:
            name = plain_name(re.sub("_(s|rad)$", "", key).removeprefix(begin))
            texts.append(f"{name} {setting_value(key, value)}")
    return ", ".join([*texts, *_orders(settings)])


LINE = re.compile(r"order_(sd_)?[0-9]+")  # of a spectrum: an order and how uncertain it is
REFERENCE = "_centre_rad"  # where phases count from says nothing
MOST_ORDERS = 6


def _orders(settings: Mapping[str, float]) -> list[str]:
    told = []
    orders = [key for key in settings if (line := LINE.fullmatch(key)) and not line[1]]
    for key in orders[:MOST_ORDERS]:
        sd = settings.get(key.replace("_", "_sd_"), 0.0)
        value, half = with_uncertainty(settings[key], 1.96 * sd)
        told.append(f"{value} ± {half}" if sd > 0 else significant(settings[key], 4))
    if more := len(orders) - len(told):
        told.append(f"{more} more")
    return [f"order{'s' * (len(orders) > 1)} {together(told)}"] if told else []


def setting_value(key: str, value: float) -> str:
    """A searched constant in the unit of its key, "12.0 min" or "5.7°"; a size in mrad."""
    if key.endswith("_rad"):
        if "size" in key:
            return f"{significant(value * 1e3)} mrad"
        return f"{significant(math.degrees(value))}°"
    if not key.endswith("_s"):
        return significant(value, 4)
    if abs(value) < LONG_TIME:
        return f"{significant(value)} s"
    return f"{significant(value / 60)} min"


def effect_head(entry: dict[str, Any]) -> str:
    """Name (* where it is on), places and typical sizes by unit of an effect, for people."""
    sizes: dict[str, list[float]] = {}
    for p in entry["parameters"]:
        value, unit = display(p["typical"] or 0.0, p["unit"])
        sizes.setdefault(unit, []).append(value)
    told = []
    for unit, found in sizes.items():
        ends = dict.fromkeys(rounded(v, 2) for v in (min(found), max(found)))
        told.append(f"{' to '.join(ends)} {unit}" if max(found) else f"{unit}, as the readings say")
    where = places(entry["places"], runs=True) or "nowhere here"
    what = ", ".join(told) or "no size of its own"
    return f"{entry['name']}{' *' * entry['on']}: {where}; {what}"
