"""Labels: names of markers and configurations, the text cells of a table."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
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
    return unicodedata.category(character) in ("Cc", "Cs") or character == "\ufeff"


class LabelCollector:
    """Gathers the labels of a column piece by piece, coded by first appearance."""

    def __init__(self) -> None:
        self._code_of: dict[str, int] = {}
        self._pieces: list[NDArray[np.int64]] = []

    def add(self, codes: NDArray[np.integer], names: Iterable[object]) -> None:
        """More rows: `codes` (n,) index into `names`, which stand in order of appearance.

        Blanks at the ends of a name are cut off.
        """
        new = [self._code_of.setdefault(str(n).strip(), len(self._code_of)) for n in names]
        self._pieces.append(np.array(new, dtype=np.int64)[codes])

    def labels(self) -> Labels:
        """All rows so far."""
        return Labels(np.concatenate(self._pieces), tuple(self._code_of))
