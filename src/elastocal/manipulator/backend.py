"""Which engine evaluates a tape: numpy's replay or compiled C, asked for and reported.

"auto" rents before it buys: a tape is replayed until replaying it has cost about as much more
than compiled code as compiling costs, and compiled then.  What has been compiled before is used
as soon as replaying has cost more than looking for it.  Both are counted in calls and rows and
never timed, so that the same work with the same cache is evaluated by the same engine.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace

from elastocal.errors import InputError
from elastocal.text import did_you_mean

BACKENDS = ("auto", "numpy", "compiled")
VARIABLE = "ELASTOCAL_BACKEND"

# Seconds, on one core of a 2023 server.  Replay costs a numpy call per instruction and block and
# is then bound by the second-level cache; compiled code keeps most operands in registers.
REPLAY_CALL = 0.3e-6  # per instruction and block
REPLAY_ROW = 0.15e-9  # per instruction and row, above compiled code
COMPILE_START, COMPILE_INSTRUCTION = 0.2, 1.2e-4  # one run of the compiler
LOOKUP_START, LOOKUP_INSTRUCTION = 0.02, 1e-6  # hash, verify and load a library

_default: str | None = None


def checked(name: str, source: str) -> str:
    """`name` where it is a backend; InputError that says where it comes from otherwise."""
    if name not in BACKENDS:
        raise InputError(
            f"{source}: unknown backend '{name}'{did_you_mean(name, list(BACKENDS))}; "
            f"valid: {', '.join(BACKENDS)}"
        )
    return name


def set_default_backend(name: str | None) -> None:
    """What tapes use that were not told otherwise; None: ELASTOCAL_BACKEND, else "auto".

    Raises InputError for an unknown name.
    """
    global _default
    _default = None if name is None else checked(name, "backend")


def chosen_backend(name: str | None = None) -> str:
    """`name`, else the default set here, else ELASTOCAL_BACKEND, else "auto".

    Raises InputError for an unknown name.
    """
    if name is not None:
        return checked(name, "backend")
    if _default is not None:
        return _default
    return checked(os.environ.get(VARIABLE, "").strip() or "auto", f"{VARIABLE} in the environment")


@dataclass
class Work:
    """Seconds that replaying a tape of `instructions` has cost above compiled code, estimated."""

    instructions: int
    wasted: float = 0.0

    def add(self, rows: int, blocks: int) -> None:
        """One more call of `rows` rows in `blocks` blocks."""
        self.wasted += self.instructions * (REPLAY_CALL * blocks + REPLAY_ROW * rows)

    @property
    def pays_to_look(self) -> bool:
        """A library that exists already pays by now."""
        return self.wasted >= LOOKUP_START + LOOKUP_INSTRUCTION * self.instructions

    @property
    def pays_to_compile(self) -> bool:
        """Compiling would have paid by now."""
        return self.wasted >= COMPILE_START + COMPILE_INSTRUCTION * self.instructions


@dataclass(frozen=True)
class BackendReport:
    """What evaluated a tape last.

    `backend` "numpy" or "compiled" ("none" before the first call), `compiler` its path and version
    where compiled, `threads` used, `cached` True where the library was found and
    not compiled by this process, `reason` why it is not compiled.
    """

    backend: str
    compiler: str | None = None
    threads: int = 1
    cached: bool = False
    reason: str = ""

    def __str__(self) -> str:
        cores = f"{self.threads} thread{'s' if self.threads > 1 else ''}"
        if self.backend == "compiled":
            return f"compiled ({self.compiler}; {cores})"
        why = f"; {self.reason}" if self.reason else ""
        return f"{self.backend} ({cores}{why})"


def summary(reports: Iterable[BackendReport]) -> str:
    """One line for a report: every engine that was used, and by how many of the tapes."""
    groups: dict[tuple[str, str | None, str], list[BackendReport]] = {}
    for report in reports:
        if report.backend != "none":
            key = (report.backend, report.compiler, report.reason)
            groups.setdefault(key, []).append(report)
    total = sum(len(group) for group in groups.values())
    lines = []
    for group in groups.values():
        threads = max(r.threads for r in group)
        share = f"{len(group)} of {total} expressions: " if len(groups) > 1 else ""
        lines.append(f"{share}{replace(group[0], threads=threads)}")
    return "; ".join(lines) or "nothing evaluated yet"
