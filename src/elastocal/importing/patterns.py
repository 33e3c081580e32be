"""Regular expressions of a mapping: compiled with a message, and the unit in a comment."""

from __future__ import annotations

import re
from collections.abc import Sequence

from elastocal.errors import InputError
from elastocal.importing.units import known_unit
from elastocal.text import quoted


def unit_in_comments(where: str, pattern: str | None, comments: Sequence[str]) -> str | None:
    """What the group `unit` of `pattern` finds in the first comment that it matches.

    Raises InputError for a pattern that is no regular expression or has no such group.
    """
    if pattern is None:
        return None
    expression = compiled(where, "unit_comment", pattern)
    if "unit" not in expression.groupindex:
        raise InputError(
            f"{where}: unit_comment = {quoted(pattern)} has no group (?P<unit>…); name the part "
            "that is the unit so"
        )
    for comment in comments:
        found = expression.search(comment)
        if found and found["unit"] and known_unit(found["unit"]):
            return found["unit"]
    return None


def compiled(where: str, key: str, pattern: str) -> re.Pattern[str]:
    """A regular expression of the mapping.  Raises InputError that names its key."""
    try:
        return re.compile(pattern)
    except re.error as error:
        raise InputError(
            f"{where}: {key} = {quoted(pattern)} is no regular expression: {error}"
        ) from None
