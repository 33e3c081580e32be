"""What a result says as a list of blocks, made once; shown by terminal, page and notebook.

Each kind of result has a function that gives its `Report`.  Texts are plain: a renderer escapes
them, typesets minus signs and decides on the layout.  A terminal shows what stands open, and with
details the folds that are `printed`; it leaves out figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

# good: use it; warn: use it knowing what is wrong, or look what changed; poor: do not use it.
Tone = Literal["good", "warn", "poor"]
TONES: dict[str, Tone] = {"good": "good", "note": "good", "care": "warn", "poor": "poor"}


@dataclass(frozen=True)
class ShownVerdict:
    """The answer in a sentence."""

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


@dataclass(frozen=True)
class Lines:
    """Sentences with labels.  Those labelled WARNING call for attention."""

    items: Sequence[tuple[str, str]]


WARNING = "Warning"


@dataclass(frozen=True)
class ShownTable:
    """A table of texts.  `words` are the columns that hold words; the others hold numbers.

    `groups` names the rows that follow, by the index of the first: {0: "base frame", 6: …}, for
    a page.  `narrow` is the same with less, for a terminal that is too narrow.
    """

    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: tuple[int, ...] = (0,)
    groups: dict[int, str] = field(default_factory=dict)
    title: str = ""
    note: str = ""
    narrow: ShownTable | None = None

    def without(self, *columns: int) -> ShownTable:
        """The table without some columns."""
        kept = [k for k in range(len(self.heads)) if k not in columns]
        heads, *rows = (tuple(row[k] for k in kept) for row in (self.heads, *self.rows))
        words = tuple(n for n, k in enumerate(kept) if k in self.words)
        return replace(self, heads=heads, rows=rows, words=words, narrow=None)

    def when_narrow(self, *columns: int) -> ShownTable:
        """The table that loses some columns where there is no room for them."""
        return replace(self, narrow=self.without(*columns))


@dataclass(frozen=True)
class Figure:
    """What `draw` puts on matplotlib's figure of `width` by `height` inches.

    `name` is what `plot` calls it, `title` says what it shows to those who cannot see it.  With a
    `space` (arm_view.Space) it is the arm, which a page lets be turned.
    """

    name: str
    title: str
    draw: Callable[[Any], None]
    height: float
    caption: str = ""
    width: float = 5.6
    space: Any = None


@dataclass(frozen=True)
class Fold:
    """What stands behind a summary, or without one open on pages; made only when it is shown.

    `printed`: by a terminal too, with details.  `figures` are the names of those it may have.
    """

    summary: str
    blocks: Callable[[], Iterable[Block]]
    printed: bool = False
    figures: tuple[str, ...] = ()


Block = ShownVerdict | KeyFigures | Heading | Sentence | Lines | ShownTable | Figure | Fold


@dataclass(frozen=True)
class Report:
    """A result as blocks: `kind` of page and what its `title` names; what the run depended on.

    `filed`: the page is to be printed and kept, so that nothing is folded.
    """

    kind: str
    title: str
    blocks: Iterable[Block]
    backend: str = ""
    seed: int | None = None
    filed: bool = False


def unfolded(blocks: Iterable[Block], which: Callable[[Fold], bool]) -> Iterator[Block]:
    """All blocks, and in the place of each fold its summary as heading and what it holds."""
    for block in blocks:
        if not isinstance(block, Fold):
            yield block
        elif which(block):
            yield Heading(block.summary)
            yield from unfolded(block.blocks(), which)
