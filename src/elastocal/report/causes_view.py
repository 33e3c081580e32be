"""What the gap is made of, where many causes act at once: findings, and their places below them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from elastocal.diagnosis.diagnosis import ComponentShare, Curve, Diagnosis, FoundEffect, Interval
from elastocal.report.blocks import ShownTable
from elastocal.report.effect_names import (
    effect_at_places,
    place,
    places,
    plain_name,
    probability,
    setting_value,
)
from elastocal.report.formatting import (
    counted,
    display,
    length,
    significant,
    together,
)
from elastocal.text import printable

# What an error of each family goes with.
FAMILIES = {
    "angle": "against its own angle",
    "gravity": "by gravity",
    "torque": "by torque",
    "load": "by load",
    "move": "by the last move",
    "time": "with time",
    "temperature": "with temperature",
    "pose": "with the pose",
    "tool": "of the tool",
}
NAMELESS = "without a name"
MOST_IN_HEADLINE = 3
FINE = 0.1  # fraction below which a tenth of a percent is told


@dataclass(frozen=True)
class Cause:
    """One finding: its share of the gap, by how much the error of new poses falls with it, and
    what it does at each place, the largest first.  `reduction` is None for what has no name."""

    name: str
    share: float
    share_ci90: Interval
    reduction: float | None
    reduction_ci90: Interval
    parts: tuple[ComponentShare, ...]
    named: bool = True


def causes(d: Diagnosis) -> list[Cause]:
    """What the gap is made of, the largest first; what has no name last, each by itself."""
    named = [c for c in d.components if c.named]
    rows = [
        Cause(
            effect_at_places(g.name, g.places), g.share, g.share_ci90,
            g.gap_reduction, g.gap_reduction_ci90,
            tuple(c for c in named if c.where in g.places and set(c.effects) & set(g.effects)),
        )
        for g in d.groups
    ]  # fmt: skip
    for c in d.components:
        if not c.named:
            name = f"{NAMELESS}, {family(c)} at {place(c.where)}"
            none = (math.nan, math.nan)
            rows.append(Cause(name, c.share, c.share_ci90, None, none, (c,), named=False))
    return rows


def family(c: ComponentShare) -> str:
    """What an error goes with, in words."""
    return FAMILIES.get(c.family, plain_name(c.family))


def share_text(fraction: float, fine: bool | None = None) -> str:
    """ "55 %", "1.6 %", "< 0.1 %"."""
    if not math.isfinite(fraction):
        return "–"
    fine = abs(fraction) < FINE if fine is None else fine
    if fine and 0 < fraction < 0.0005:
        return "< 0.1 %"
    digits = 1 if fine else 0
    return f"{round(100 * fraction, digits) + 0.0:.{digits}f} %"


def span_text(ends: Interval, middle: float) -> str:
    """ "50 to 59 %", "1.2 to 2.0 %", as fine as what is in the `middle`."""
    low, high = ends
    if not (math.isfinite(low) and math.isfinite(high)):
        return "–"
    fine = abs(middle) < FINE
    return f"{share_text(low, fine).removesuffix(' %')} to {share_text(high, fine)}"


def headline_of_causes(d: Diagnosis) -> str:
    """The largest causes with their shares, and what is left open."""
    found = [c for c in causes(d) if c.named]
    large = [c for k, c in enumerate(found[:MOST_IN_HEADLINE]) if k == 0 or c.share >= FINE]
    told = [
        f"{c.name} ({share_text(c.share)}{' of the remaining error' * (k == 0)})"
        for k, c in enumerate(large)
    ]
    if more := len(found) - len(told):
        told.append(counted(more, "smaller cause"))
    first = d.groups[0]
    plural = len(first.places) > 1 or first.name.endswith("errors")
    text, several = together(told), len(found) > 1 or plural
    if d.verdict == "explained":
        return f"{text} explain{'s' * (not several)} the remaining error."
    if d.verdict == "ambiguous":
        n = len(d.indistinguishable)
        names = "one effect" if n == 1 else f"{n} effects"
        verb = "cause" if several else "causes"
        return f"{text} {verb} the remaining error; these data leave {names} of it open."
    at = places(dict.fromkeys(c.where for c in d.components if not c.named))
    where = f" at {at}" if at else ""
    return (
        f"{text} cause{'s' * (not several)} part of the remaining error; an effect outside the "
        f"catalogue acts{where}."
    )


def cause_table(d: Diagnosis) -> ShownTable:
    """One row per finding: its share of the gap, and what it takes off the error of new poses."""
    rows = [
        (
            c.name, share_text(c.share), span_text(c.share_ci90, c.share),
            "–" if c.reduction is None else share_text(c.reduction),
            span_text(c.reduction_ci90, c.reduction or 0.0),
        )
        for c in causes(d)
    ]  # fmt: skip
    if d.gap.unexplained_share >= FINE**2:
        rows.append(("unexplained", share_text(d.gap.unexplained_share), "–", "–", "–"))
    heads = ("cause", "share", "90 %", "error falls by", "90 %")
    return ShownTable(heads, rows, title="Causes of the remaining error", note=(
        "share: part of the squared remaining error that goes when this is added last. error falls "
        "by: at new poses, if only this is added to the model."
    ))  # fmt: skip


def place_table(d: Diagnosis) -> ShownTable:
    """What acts at each place, below the finding that it belongs to."""
    rows: list[tuple[str, ...]] = []
    groups: dict[int, str] = {}
    told: list[ComponentShare] = []
    for cause in causes(d):
        parts = [c for c in cause.parts if c not in told]
        if parts:
            groups[len(rows)] = cause.name
        for c in parts:
            effects = ", ".join(map(plain_name, c.effects)) if c.named else NAMELESS
            rows.append((
                place(c.where), family(c), effects, f"{length(c.rms)} ({lengths(c.rms_ci95)})",
                f"{share_text(c.share)} ({span_text(c.share_ci90, c.share).removesuffix(' %')})",
                probability(c.probability),
            ))  # fmt: skip
        told += parts
    heads = ("place", "error", "as", "rms (95 %)", "share (90 %)", "probability")
    table = ShownTable(heads, rows, (0, 1, 2), groups, title="Place by place")
    return table.when_narrow(2)  # what it is as effects stands in the table of parameters too


def lengths(ends: Interval) -> str:
    """ "266 to 293 µm", "0.90 µm to 1.20 mm"."""
    low, high = map(length, ends)
    unit = high[high.rfind(" ") :]
    return f"{low.removesuffix(unit)} to {high}" if low.endswith(unit) else f"{low} to {high}"


def curve_span(curve: Curve) -> str:
    """How far a curve goes from its lowest to its highest point."""
    moved = max(curve.y) - min(curve.y)
    if curve.y_unit == "m":
        return length(moved)
    shown, unit = display(moved, curve.y_unit)
    return f"{significant(shown)} {unit}"


def curve_line(d: Diagnosis) -> str:
    """How far the error curve of each joint goes from its lowest to its highest point."""
    told = [f"{curve_span(curve)} ({place(curve.entry)})" for curve in d.curves]
    return f"the joints' errors against their own angles span {together(told)}." if told else ""


def assumed_order(d: Diagnosis) -> str:
    """That the moves between visits were taken from the order of the rows, where they matter."""
    matters = any(c.family == "move" for c in d.components) or "approach" in d.model_keys
    if not matters or d.calibrated is None or d.calibrated.observed.table.time is not None:
        return ""
    return (
        "the last move is that from the visit before, in the order of the rows; if they were not "
        "measured so, do not rely on effects of the last move."
    )


def slight_text(d: Diagnosis) -> str:
    """What is in the model and no finding; nothing where all matters."""
    if not d.slight:
        return ""
    return (
        f"{added_text(d.slight)}: each probably moves the markers by less than a hundredth of the "
        "remaining error. They correct the arm and are not findings."
    )


# Corrections that have no name.


def field_table(d: Diagnosis) -> ShownTable:
    """The smooth corrections without a name: where, what they follow, how large and how smooth."""
    rows = [row for f in d.fields for row in _followed(f)]
    heads = ("correction at", "follows", "size", "over", "error falls by", "95 %")
    note = (
        "Smooth functions without a physical name; they hold where the arm was measured: size "
        "(standard deviation) and the length over which they change."
    )
    return ShownTable(heads, rows, (0, 1), title="Smooth corrections", note=note)


def _followed(f: FoundEffect) -> Iterable[tuple[str, ...]]:
    """A row for everything that a field follows; the last columns in the first row only."""
    fall = f.gap_reduction
    told: Sequence[str] = (share_text(fall), span_text(f.gap_reduction_ci95, fall))
    for key, value in f.settings.items():
        name, _, rest = key.rpartition("size")
        if not name or rest not in ("", "_rad"):
            continue
        over = f.settings.get(f"{name}length{rest}", math.nan)
        of = name.rstrip("_").partition("_")[2]
        timed = of == "time"
        suffix = "s" if timed else "rad"
        yield (
            place(f.where),
            "the time" if timed else f"the angle of {place(of)}" if of else "its own angle",
            _motion(f.where, value),
            setting_value(f"over_{suffix}", over) if math.isfinite(over) else "–",
            *told,
        )
        told = ("", "")


def _motion(where: str, size: float) -> str:
    """A size that is m and rad, or one of them, by the place that moves."""
    if where.startswith("joint"):
        return f"{significant(size * 1e3, 2)} mrad"
    if where.startswith("marker:"):
        return f"{significant(size * 1e3, 2)} mm"
    return f"{significant(size * 1e3, 2)} mm, mrad"


def added_text(found: Sequence[FoundEffect]) -> str:
    """What a written cell has more, by effect: "gear_ripple:joint1", or many of them in short."""
    if len(found) <= 2 * MOST_IN_HEADLINE:
        return ", ".join(f"{f.effect}:{f.where}" for f in found)
    at: dict[str, list[str]] = {}
    for f in found:
        at.setdefault(f.effect, []).append(f.where)
    return ", ".join(f"{printable(name)} ({places(where)})" for name, where in at.items())
