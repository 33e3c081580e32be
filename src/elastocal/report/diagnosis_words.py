"""Names and numbers of a diagnosis in words: effects, places, probabilities, settings."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from elastocal.diagnosis.result import Candidate, EffectAt, FoundEffect, NoiseFloor
from elastocal.report.units import length, significant
from elastocal.report.words import printable

# Places that are the only one their effects have: "base drift", not "base drift at base".
SINGLE = ("base", "wrist", "load", "tracker")
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


def name_of(text: str) -> str:
    """A step of the budget or a rival: "base_frame", "link_bending at link2", "backlash:joint3"."""
    effect, colon, where = text.replace(" at ", ":", 1).partition(":")
    return effect_at(EffectAt(effect, where)) if colon else driver_name(plain_name(text))


def driver_name(driver: str) -> str:
    """ "joint2 angle" → "joint 2 angle"."""
    return re.sub(r"\b(joint|link)([0-9]+)\b", r"\1 \2", printable(driver))


def together(parts: Sequence[str], last: str = "and") -> str:
    """ "a, b and c"."""
    return f" {last} ".join([p for p in (", ".join(parts[:-1]), *parts[-1:]) if p])


def capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def probability(p: float) -> str:
    """Two decimals, and never a certainty."""
    if not math.isfinite(p):
        return "–"
    if p > 0.995:
        return "> 0.99"
    return "< 0.01" if p < 0.005 else f"{p:.2f}"


def p_value(p: float) -> str:
    """Two digits, or that it is below a thousandth."""
    if not math.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else significant(p, 2)


def size_of(p: float) -> str:
    """ "p = 0.02", "p < 0.001"."""
    text = p_value(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def percent(fraction: float) -> str:
    """ "75 %"; "none" where there is no number."""
    return f"{round(100 * fraction)} %" if math.isfinite(fraction) else "none"


def reduction(f: FoundEffect) -> str:
    """ "75 % (63 to 84 %)"."""
    low, high = f.gap_reduction_ci95
    if not (math.isfinite(low) and math.isfinite(high)):
        return percent(f.gap_reduction)
    return f"{percent(f.gap_reduction)} ({round(100 * low)} to {percent(high)})"


def settings_text(settings: Mapping[str, float]) -> str:
    """Searched constants with their units: "jump time 12.0 min, ripple order 101"."""
    return ", ".join(_setting(key, value) for key, value in settings.items())


def _setting(key: str, value: float) -> str:
    name, _, unit = key.rpartition("_")
    if unit != "s":
        return f"{plain_name(key)} {significant(value, 4)}"
    if abs(value) < LONG_TIME:
        return f"{plain_name(name)} {significant(value)} s"
    return f"{plain_name(name)} {significant(value / 60)} min"


def repeatabilities(noise: NoiseFloor, kinds: Iterable[str]) -> str:
    """Every joint's scatter from visit to visit: "joint 1 6.0 µrad, joint 2 5.1 µrad"."""
    texts = [
        f"joint {i + 1} {significant(value * 1e6, 2)} {'µrad' if kind == 'revolute' else 'µm'}"
        for i, (value, kind) in enumerate(zip(noise.repeatability, kinds, strict=True))
        if value > 0
    ]
    return ", ".join(texts) or "none that shows"


def noise_lines(noise: NoiseFloor, kinds: Iterable[str]) -> list[str]:
    """What the data themselves say of the noise, a sentence each."""
    sigma = length(noise.reading_sigma)
    if noise.stated:
        text = f"A reading scatters by {sigma} rms per axis, {significant(noise.stated_factor, 2)}"
        lines = [f"{text} times what is stated."]
    else:
        lines = [f"A reading scatters by {sigma} rms per axis; nothing was stated."]
    lines.append(f"Repeatability from visit to visit: {repeatabilities(noise, kinds)}.")
    if noise.shared > 0:
        lines.append(
            "All visits of a configuration share a further scatter of "
            f"{significant(noise.shared, 2)} times that."
        )
    if noise.pure_error is None:
        lines.append("No reading is repeated, so the noise is known from the residuals only.")
    else:
        lines.append(f"Repeats scatter by {length(noise.pure_error)} rms per axis.")
    if noise.faulty:
        n = len(noise.faulty)
        lines.append(
            f"{n} faulty reading{'s were' if n > 1 else ' was'} left out, "
            f"the worst {length(max(f.error for f in noise.faulty))} off."
        )
    return lines
