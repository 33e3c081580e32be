"""The one exception root: every failure a user can cause or must act on.

A message says what is wrong, where (file, row, column or key), what was found,
and what to do.  The command line turns `InputError` into exit code 2 and
`InsufficientDataError` into exit code 1, both without a traceback.
"""


class ElastocalError(Exception):
    """Root of all errors that elastocal raises on purpose."""

    exit_code = 2


class InputError(ElastocalError):
    """The input is wrong: a file, a key, a column, a unit, a value."""

    exit_code = 2


class InsufficientDataError(ElastocalError):
    """The input is well formed, but the data do not support an answer."""

    exit_code = 1


def require(condition: bool, message: str) -> None:
    """Raise InputError with `message` unless `condition` holds."""
    if not condition:
        raise InputError(message)
