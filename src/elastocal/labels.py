"""Labels: names of markers and configurations, the text cells of a table."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Labels:
    """`codes` (n,) index into `names`, which stand in order of first appearance."""

    codes: NDArray[np.int64]
    names: tuple[str, ...]


def is_label(text: str) -> bool:
    """Can this text stand in a table cell and be read back: one line, no blanks at its ends?"""
    return bool(text) and text == text.strip() and not any(map(_is_control, text))


def _is_control(character: str) -> bool:
    return unicodedata.category(character) in ("Cc", "Cs")


def in_order(codes: NDArray[np.integer], names: Sequence[str]) -> Labels:
    """Labels with blanks at their ends cut off, renumbered by first appearance.

    `codes` (n,) index into `names`; names that no row uses are dropped.
    """
    n = len(codes)
    first = np.full(len(names), n)
    first[codes[::-1]] = np.arange(n)[::-1]
    new_code: dict[str, int] = {}
    renumber = np.zeros(len(names), dtype=np.int64)
    for old in np.argsort(first, kind="stable"):
        if first[old] < n:
            renumber[old] = new_code.setdefault(str(names[old]).strip(), len(new_code))
    return Labels(renumber[codes], tuple(new_code))
