"""How messages name a key of the cell file: dotted, or 'key of [[table]] no. 2'."""

from __future__ import annotations

import re
from collections.abc import Sequence

from elastocal.text import quoted


def dotted(keys: Sequence[str]) -> str:
    """Keys as TOML writes them: joined by dots, quoted where they are no bare keys."""
    return ".".join(k if re.fullmatch(r"[\w-]+", k, re.ASCII) else quoted(k) for k in keys)


def header(keys: Sequence[str | int]) -> str:
    """A table as a message names it: [design], or [[design.test_pose]] no. 2.

    A number (from 0) after a key says which of its tables [[…]] is meant.
    """
    names = dotted([k for k in keys if isinstance(k, str)])
    if keys and isinstance(keys[-1], int):
        return f"[[{names}]] no. {keys[-1] + 1}"
    return f"[{names}]"


def place(*keys: str | int) -> str:
    """A key as a message names it: design.poses, or q_deg of [[design.test_pose]] no. 2."""
    last = max((i for i, k in enumerate(keys) if isinstance(k, int)), default=-1)
    rest = dotted([k for k in keys[last + 1 :] if isinstance(k, str)])
    if last < 0:
        return rest
    table = header(keys[: last + 1])
    return f"{rest} of {table}" if rest else table
