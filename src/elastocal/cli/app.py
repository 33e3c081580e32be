"""What all commands share: the app, errors and exit codes, progress, output checks, Ctrl-C."""

from __future__ import annotations

import functools
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperGroup

from elastocal.errors import TRACEBACK, ElastocalError, InputError, explained, options_as_flags
from elastocal.files import check_ending
from elastocal.screen import complain, interrupts, safe_console, say

if TYPE_CHECKING:
    from rich.console import Console

    from elastocal.cell.work_cell import Cell

# Heavy imports (casadi, pin, pandas) stand inside the commands: --help must not wait for them.

# The order of the work, in which --help lists the verbs.
VERBS = (
    "init", "effects", "design", "simulate", "import", "identify", "diagnose", "next",
    "compensate", "export", "compare", "study", "demo",
)  # fmt: skip


HELP = ["-h", "--help"]
INTERRUPTED = 130  # 128 + SIGINT, as shells count
# Arguments and options that name what a command reads.
READ = (
    "cell", "data", "result", "targets", "files", "folder", "test", "covariance", "knowledge",
    "augment", "mapping", "robot", "old", "new",
)  # fmt: skip


class InOrder(TyperGroup):
    """Commands in the order of the work, not of their registration."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of the commands; one that VERBS does not know comes last."""
        known = super().list_commands(ctx)
        return sorted(known, key=lambda name: VERBS.index(name) if name in VERBS else len(VERBS))

    def main(self, *args: Any, **extra: Any) -> Any:
        """As inherited; but however it ends, one message says why, with names escaped."""
        told, standalone = StringIO(), extra.pop("standalone_mode", True)
        extra["standalone_mode"] = False
        try:
            words = (args[0] if args else extra.get("args")) or sys.argv[1:]
            _refuse_empty(words)
            code = 0 if self._helped(words) else super().main(*args, **extra)
        except (ElastocalError, OSError, typer.Abort, KeyboardInterrupt, EOFError) as error:
            code = _ended(error)
        except Exception as error:
            if not hasattr(error, "show"):
                raise
            error.show(told)  # of typer's own: a usage error
            say(told.getvalue(), error=True, end="")
            code = getattr(error, "exit_code", 2)
        if code == INTERRUPTED:
            complain("interrupted")
        if not standalone:
            return code
        sys.exit(code or 0)

    def _helped(self, words: Sequence[str]) -> bool:
        """Whether `words` are VERB --help, which is then shown.  As inherited it would wait for the
        options before the verb, whose reading loads pydantic and CasADi (0.3 s)."""
        if len(words) != 2 or words[0] not in self.commands or words[1] not in HELP:
            return False
        above = typer.Context(self, info_name="elastocal", **self.context_settings)
        with suppress(typer.Exit):
            self.commands[words[0]].make_context(words[0], [words[1]], parent=above)
        return True


def _refuse_empty(words: Sequence[str]) -> None:
    """Raises InputError for an empty argument, as a shell's unset variable leaves it: as a path it
    would mean the folder where one is."""
    for before, word in pairwise(["", *words]):
        if not word and before != "--backend":  # empty like its variable: none is chosen
            place = f" after {before}" if before else ""
            raise InputError(
                f"an empty argument{place} says nothing; give a value, or leave it out"
            )


app = typer.Typer(
    cls=InOrder,
    help="Calibrate industrial robot arms and explain what is left over.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": HELP, "max_content_width": 100},
)


def reporting_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Turn what the user can act on into a message and an exit code, never a traceback."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        before = len(interrupts)  # of an earlier command in this process
        try:
            with options_as_flags(), warnings.catch_warnings():
                # numpy's, of overflows: what comes of them is judged where a number must be one.
                warnings.simplefilter("ignore", RuntimeWarning)
                command(*args, **kwargs)
        except (ElastocalError, OSError, KeyboardInterrupt) as error:
            raise typer.Exit(_ended(error)) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if hasattr(error, "show"):  # of typer's own: a usage error
                raise
            if len(interrupts) > before:  # which a library has turned into an error of its own
                raise typer.Exit(INTERRUPTED) from None
            if os.environ.get(TRACEBACK):
                traceback.print_exc()
            message, code = explained(error, [kwargs.get(name) for name in READ])
            complain(message)
            raise typer.Exit(code) from None

    return run


def _ended(error: BaseException) -> int:
    """Say why a command ends; the exit code."""
    if isinstance(error, ElastocalError):
        complain(str(error))
        return error.exit_code
    if not isinstance(error, OSError):
        return INTERRUPTED
    if isinstance(error, BrokenPipeError):
        # The reader of stdout went away (… | head): nothing is wrong with the input.
        return 0
    # What reads and writes files names them; streams have no name.
    complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
    return 2


def console(stderr: bool = False) -> Console:
    return safe_console(stderr=stderr)


# The files that a command reads and writes: checked before the work, written after it.


def repeated() -> str:
    """The command line that repeats this run, as results name it."""
    return shlex.join(["elastocal", *sys.argv[1:]])


def check_outputs(*asked: tuple[Path | None, str]) -> list[Path]:
    """The outputs asked for, each with the endings that it may have, between blanks; one that
    cannot be written, or is named as something else, is refused before the work starts."""
    wanted = [(path, endings.split()) for path, endings in asked if path is not None]
    for path, endings in wanted:
        folder = path.absolute().parent
        if path.is_dir():
            raise InputError(f"{path} is a directory; name a file to write")
        if not folder.is_dir():
            raise InputError(f"{path}: the folder {folder} does not exist; create it first")
        if not os.access(folder, os.W_OK):
            raise InputError(f"{path}: no permission to write in {folder}")
        if endings:
            check_ending(path, endings)
    return [path for path, _ in wanted]


def check_apart(written: list[Path], read: Iterable[Path | None], cell: Cell | None = None) -> None:
    """Refuse to write over an input or a file that the `cell` names, or two outputs into one."""
    # Not Path.resolve, which raises RuntimeError where links go round in a circle.
    inputs = {os.path.realpath(path) for path in read if path is not None}
    inputs |= set() if cell is None else {os.path.realpath(path) for path in files_of(cell)}
    taken: set[str] = set()
    for path in written:
        real = os.path.realpath(path)
        if real in inputs:
            raise InputError(f"{path} is read and would be written over; name another output")
        if real in taken:
            raise InputError(f"{path}: two outputs of the same name; name another one")
        taken.add(real)


def files_of(cell: Cell) -> list[Path]:
    """Files that the cell names and its model or a plan depends on."""
    from elastocal.plugin_loader import is_plugin_file

    robot, targets = cell.robot, cell.design.test_path
    solids = [*cell.workspace.obstacles, *(body.solid for body in cell.workspace.bodies)]
    path = None if targets is None else targets.file
    named = [robot.urdf, robot.mjcf, robot.dh, robot.masses, cell.design.taught, path]
    named += [solid.mesh for solid in solids]
    named += [Path(name) for name in cell.plugins if is_plugin_file(name)]
    return [path for path in named if path is not None]
