"""Which format a file is written in: by its ending, or as asked for."""

from __future__ import annotations

from pathlib import Path

from elastocal.errors import InputError, option
from elastocal.text import did_you_mean

ENDINGS = {
    ".urdf": "urdf",
    ".xml": "mjcf",
    ".mjcf": "mjcf",
    ".csv": "dh",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".json": "json",
}
FORMATS = ("urdf", "mjcf", "dh", "mdh", "yaml", "json")


def format_of(path: Path, asked: str | None) -> str:
    """The format `asked` for, else that of the file's ending.

    Raises InputError for an unknown format, and for an ending that tells none.
    """
    if asked is not None:
        if asked.lower() not in FORMATS:
            raise InputError(
                f"{option('format')} takes one of {', '.join(FORMATS)}; found '{asked}'"
                f"{did_you_mean(asked.lower(), FORMATS)}"
            )
        return asked.lower()
    found = ENDINGS.get(path.suffix.lower())
    if found is None:
        raise InputError(
            f"{path}: the ending '{path.suffix}' tells no format; use one of "
            f"{', '.join(ENDINGS)}, or name it by {option('format')}: {', '.join(FORMATS)}"
        )
    return found
