"""Hints for wrong names: the nearest valid one, and a list of what there is."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

SHOWN = 60


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.5) -> str | None:
    """The valid name closest to `name`, upper and lower case alike; None where none is near."""
    by_lower = {v.lower(): v for v in reversed(list(valid))}
    # difflib is quadratic, and a name this long is no typing error anyway.
    near = get_close_matches(name[:SHOWN].lower(), by_lower, n=1, cutoff=cutoff)
    return by_lower[near[0]] if near else None


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """' (did you mean 'x'?)' for the nearest valid name, or '' where none is near."""
    near = nearest(name, valid)
    return f" (did you mean '{near}'?)" if near else ""


def listed(names: Iterable[str], limit: int = 30) -> str:
    """Names joined by commas, cut after `limit` with the number left off."""
    names = list(names)
    more = f", … ({len(names) - limit} more)" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def quoted(found: object) -> str:
    """`found` as a message shows it: quoted, on one line, cut when long."""
    text = found if isinstance(found, str) else str(found)
    text = repr(text[:SHOWN] + "…") if len(text) > SHOWN else repr(text)
    return text if isinstance(found, str) else text[1:-1]
