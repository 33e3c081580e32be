"""Dates and times of exports as seconds."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from elastocal.errors import InputError
from elastocal.text import quoted

ISO = "ISO 8601"


class Clock:
    """Texts → seconds since 1970 (UTC); a time without a zone is taken as UTC.

    The first of `formats` (strptime, or ISO 8601) that reads a column's first text reads all.
    """

    def __init__(self, formats: Sequence[str]) -> None:
        self.formats = tuple(formats)
        self.chosen: str | None = None

    def seconds(self, text: str) -> float:
        """Seconds of one text.  Raises ValueError where no format fits."""
        if self.chosen is None:
            for candidate in (*self.formats, ISO):
                try:
                    value = _parsed(text, candidate)
                except ValueError:
                    continue
                self.chosen = candidate
                return value
            raise ValueError(text)
        return _parsed(text, self.chosen)

    def complaint(self, where: str, text: str) -> InputError:
        """What to say of a text that `seconds` did not take."""
        expected = self.chosen or " or ".join([*self.formats, ISO])
        return InputError(
            f"{where}: {quoted(text)} is no time of the form {expected}; set time_format in "
            "[[source]]"
        )


def _parsed(text: str, form: str) -> float:
    bare = " ".join(text.split())
    moment = datetime.fromisoformat(bare) if form == ISO else datetime.strptime(bare, form)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    try:
        return moment.timestamp()
    except OverflowError:
        raise ValueError(text) from None
