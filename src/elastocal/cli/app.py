"""What all commands share: the app, errors and exit codes, outputs, and how a command is declared.

    @command(verb=verbs.identify, offers="test method noise fixed seed")
    def identify(cell: Path, data: Path, asked: Asked, report: Path | None = None, run: Run): ...

In place of `asked` stand the options that the verb `offers`: name, kind and default are those of
its argument, the help is the first sentence of what its docstring says of that.  In place of `run`
stand the flags that all commands have.  All others are arguments, and where they have a default
options, of the command itself: the help of each stands under Args in its docstring, in brackets
what stands for a value, as in "set_ (KEY=VALUE): Option of the study", unless it is `KNOWN`.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from copy import copy
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, get_args

# Many small matrices: a second thread of the linear algebra library only waits for the first.
# It must be said before numpy is loaded, and the user's own setting wins.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# No plug-in of pydantic has to do with a cell file; looking for them reads what is installed.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

# Figures are drawn into files; what a window would take does not concern them.
os.environ["MPLBACKEND"] = "agg"

import typer
from typer.core import TyperGroup

from elastocal import __version__
from elastocal.above import LARGEST_SEED, kinds_of
from elastocal.files import TRACEBACK, apart, check_output, explained, together
from elastocal.messages import ElastocalError, InputError, flag_of, json_text, require, saying
from elastocal.screen import complain, interrupts, progress_line, safe_console, say

if TYPE_CHECKING:
    from rich.console import Console

    from elastocal.cell import Cell

# Heavy imports (casadi, pin, pandas) stand inside the commands: --help must not wait for them.

HELP = ["-h", "--help"]
INTERRUPTED = 130  # 128 + SIGINT, as shells count
# Arguments and options that name what a command reads.
READ = (
    "cell", "data", "result", "targets", "files", "folder", "test", "covariance", "knowledge",
    "augment", "mapping", "robot", "old", "new",
)  # fmt: skip
reading: list[object] = []  # what these are of the command that runs


class Told(TyperGroup):
    """A group of commands that, however it ends, says why in one message, with names escaped."""

    def main(self, *args: Any, **extra: Any) -> Any:
        words = (args[0] if args else extra.get("args")) or sys.argv[1:]
        try:
            # An empty argument is what a shell's unset variable leaves: as a path it would mean the
            # folder where one is.
            for before, word in pairwise(["", *words]):
                place = f" after {before}" if before else ""
                require(
                    bool(word) or before == "--backend",  # empty like its variable: none is chosen
                    f"an empty argument{place} says nothing; give a value, or leave it out",
                )
            how = extra | {"standalone_mode": False}
            code = 0 if self._helped(words) else super().main(*args, **how)
        except (Exception, KeyboardInterrupt) as error:
            code = _ended(error)
        if code == INTERRUPTED:
            complain("interrupted")
        sys.exit(code or 0)

    def invoke(self, ctx: Any) -> Any:
        """A message and an exit code, never a traceback; nothing of what the user can act on is
        left to typer, which takes an EOFError for an interrupt."""
        before = len(interrupts)  # of an earlier command in this process
        try:
            with saying(flags=True), warnings.catch_warnings():
                # numpy's, of overflows: what comes of them is judged where a number must be one.
                warnings.simplefilter("ignore", RuntimeWarning)
                return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as error:
            if isinstance(error, typer.Exit | typer.Abort) or hasattr(error, "show"):
                raise  # typer's own, as a usage error
            raise typer.Exit(_ended(error, reading, len(interrupts) > before)) from None

    def _helped(self, words: Sequence[str]) -> bool:
        """Whether `words` are VERB --help, which is then shown.  As inherited it would wait for the
        options before the verb, whose reading loads pydantic and CasADi (0.3 s)."""
        if len(words) != 2 or words[0] not in self.commands or words[1] not in HELP:
            return False
        above = typer.Context(self, info_name="elastocal", **self.context_settings)
        with suppress(typer.Exit):
            self.commands[words[0]].make_context(words[0], [words[1]], parent=above)
        return True


app = typer.Typer(
    cls=Told,
    help="Calibrate industrial robot arms and explain what is left over.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": HELP, "max_content_width": 100},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"elastocal {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Version.")
    ] = False,
    backend: Annotated[
        str | None, typer.Option(help="What evaluates the model: auto or numpy; default: auto.")
    ] = None,
) -> None:
    """Calibrate industrial robot arms and explain what is left over."""
    from elastocal.model.evaluate import VARIABLE, checked, chosen_backend

    # By the environment, so that processes which a command starts choose the same.
    if backend is not None:
        os.environ[VARIABLE] = checked(backend.strip() or "auto", "--backend")
    chosen_backend()
    if os.environ.get("ELASTOCAL_CACHE"):
        complain("ELASTOCAL_CACHE is no longer read, as nothing is kept between runs; unset it")


def _ended(error: BaseException, read: Sequence[object] = (), interrupted: bool = False) -> int:
    if isinstance(error, ElastocalError):
        complain(str(error))
        return error.exit_code
    if isinstance(error, BrokenPipeError):
        # The reader of stdout went away (… | head): nothing is wrong with the input.
        return 0
    if isinstance(error, OSError):
        # What reads and writes files names them; streams have no name.
        complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return 2
    # An interrupt may have been turned by a library into an error of its own.
    if interrupted or not isinstance(error, Exception) or isinstance(error, typer.Abort):
        return INTERRUPTED
    if hasattr(error, "show"):  # of typer's own: a usage error
        error.show(told := StringIO())
        say(told.getvalue(), error=True, end="")
        return getattr(error, "exit_code", 2)
    if os.environ.get(TRACEBACK):
        traceback.print_exc()
    message, code = explained(error, read)
    complain(message)
    return code


def repeated() -> str:
    return shlex.join(["elastocal", *sys.argv[1:]])


Asked: TypeAlias = dict[str, Any]
# Metavar and meaning of an option that is another thing as a text than in Python.
Texts: TypeAlias = Mapping[str, tuple[str, Callable[[Any], Any]]]

PAGES = ".html .htm"  # endings
# Arguments and options that are the same in all commands, unless one says otherwise.
KNOWN: dict[str, Any] = {
    "cell": typer.Argument(help="Cell file (TOML): robot, tool, tracker, model."),
    "data": typer.Argument(help="Measurements (CSV or Parquet)."),
    "result": typer.Argument(help="Result of identify -o (JSON)."),
    "output": typer.Option("-o", "--output", help="Write the result as JSON."),
    "report": typer.Option("--report", help="Write a report (one HTML page)."),
    "seed": typer.Option(min=0, max=LARGEST_SEED, help="Seed of all random draws."),
    "plugins": typer.Option(
        "--plugins", help="Run the Python code that the cell names in [plugins]."
    ),
    "json": typer.Option("--json", help="Print the result as JSON to stdout."),
    "quiet": typer.Option("--quiet", "-q", help="No progress."),
}
FORCE = tuple[float, float, float]
# What an argument may be in Python → what it is here; of several the first.
TAKEN: dict[str, Any] = {
    "Sequence[str]": list[str], "Path": Path, "str": str, "ArrayLike": FORCE,
    "bool": bool, "int": int, "float": float, "Sequence[int]": str,
}  # fmt: skip


def whole_numbers(text: str, takes: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{takes}; found '{text}'") from None


def named_numbers(stated: Iterable[str], takes: str) -> dict[str, float]:
    found = {}
    for text in stated:
        name, _, number = text.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            raise InputError(f"{takes}; found '{text}'") from None
    return found


class Run:
    def __init__(self, plugins: bool = False, json: bool = False, quiet: bool = False) -> None:
        self.plugins, self.json, self._quiet = plugins, json, quiet
        self.written: list[Path] = []

    def writes(self, *asked: tuple[Path | None, str]) -> None:
        """Each output asked for with the endings that it may have, between blanks; one that cannot
        be written, or is named as something else, is refused before the work starts."""
        for path, endings in asked:
            if path is not None:
                check_output(path, endings.split())
        self.written = [path for path, _ in asked if path is not None]

    def reads(self, *paths: Path | None, cell: Cell | None = None) -> list[Path]:
        """Refused is to write over an input or a file that the `cell` names, or two outputs into
        one."""
        given = [path for path in paths if path is not None]
        from elastocal.cell import files_of

        apart(self.written, [*given, *(() if cell is None else files_of(cell))])
        return given

    def write(self, *asked: tuple[Path | None, Callable[[Path], Any]]) -> None:
        """The outputs asked for, each by the function beside it: all of them or none."""
        with together():
            for path, write in asked:
                if path is not None:
                    write(path)

    def progress(self) -> AbstractContextManager[Callable[[str], None]]:
        return progress_line(self._quiet)

    def answer(
        self, content: Callable[[], Any], show: Callable[[Console], None], files: bool = True
    ) -> bool:
        """The result as JSON, or shown to people, with the `files` written; True for people."""
        if self.json:
            say(json_text(content()))
            return False
        show(safe_console())
        for path in self.written if files else ():
            say(f"wrote {path}")
        return True


def command(
    *name: str, verb: Callable[..., Any] | None = None, offers: str = "",
    texts: Texts | None = None, flags: str = "plugins json quiet", **how: Any,
) -> Callable[[Callable[..., None]], Callable[..., None]]:  # fmt: skip
    """Register a command of the app, which ends with a message where the user can act on it."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        offered = {} if verb is None else dict(_offered(verb, offers.split(), texts or {}))
        own = inspect.signature(function, eval_str=True).parameters
        told = _told(function)
        parameters: list[inspect.Parameter] = []
        for each in own.values():
            if each.name == "asked":
                parameters += offered.values()
            elif each.name == "run":
                parameters += [_parameter(n, bool, False, KNOWN[n]) for n in flags.split()]
            else:
                parameters.append(_own(each, *told.get(each.name, ("", None))))

        @functools.wraps(function)
        def run(**given: Any) -> None:
            reading[:] = [given.get(name) for name in READ]
            if "run" in own:
                given["run"] = Run(**{n: given.pop(n) for n in flags.split()})
            if "asked" in own:
                taken = {n: given.pop(n) for n in offered}
                meaning = {n: means for n, (_, means) in (texts or {}).items()}
                given["asked"] = {
                    n: meaning[n](value) if n in meaning else value
                    for n, value in taken.items()
                    if value is not None
                }
            function(**given)

        run.__doc__ = (inspect.getdoc(function) or "").partition("\n\nArgs:\n")[0]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        return app.command(*name, **how)(run)

    return register


def _offered(
    verb: Callable[..., Any], names: Iterable[str], texts: Texts
) -> Iterator[tuple[str, inspect.Parameter]]:
    signature, told = inspect.signature(verb).parameters, _told(verb)
    for name in names:
        kinds, default = kinds_of(signature[name].annotation), signature[name].default
        taken = next(kind for known, kind in TAKEN.items() if known in kinds)
        metavar, (help, _) = None, told.get(name, ("", None))  # none by python -OO
        help = re.split(r"(?<=\.) (?=[A-Z(])", help)[0]
        if name in texts:
            taken, default, metavar = str, None, texts[name][0]
        elif taken == list[str]:
            default, metavar, help = None, "NAME", f"{help.removesuffix('.')}; repeatable."
        elif taken == FORCE:
            metavar = "X Y Z"
        idle = help.startswith("Has no effect")  # taken where scripts give it
        option = typer.Option(flag_of(name), metavar=metavar, help=help, hidden=idle)
        kind = taken | None if default is None else taken
        yield name, _parameter(name, kind, default, KNOWN.get(name, option))


def _own(each: inspect.Parameter, help: str, metavar: str | None) -> inspect.Parameter:
    kind, stated = each.annotation, getattr(each.annotation, "__metadata__", ())
    if stated:
        kind, option = get_args(each.annotation)[0], copy(stated[0])
    elif each.name in KNOWN:
        option = copy(KNOWN[each.name])
    elif each.default is inspect.Parameter.empty:
        option = typer.Argument()
    else:
        option = typer.Option(flag_of(each.name.rstrip("_")))
    option.help, option.metavar = help or option.help, option.metavar or metavar
    if FORCE in (kind, *get_args(kind)):
        option.metavar = "X Y Z"
    return _parameter(each.name, kind, each.default, option)


def _parameter(name: str, kind: Any, default: Any, option: Any) -> inspect.Parameter:
    how = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, how, default=default, annotation=Annotated[kind, option])


def _told(verb: Callable[..., Any]) -> dict[str, tuple[str, str | None]]:
    """What a docstring says of each argument, with flags for the names of others, and what stands
    for its value."""
    block = (inspect.getdoc(verb) or "").partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.split(r"^    (?=\w+(?: \(\S+\))?: )", block, flags=re.M)[1:]
    found: dict[str, tuple[str, str | None]] = {}
    for head, _, text in (" ".join(entry.split()).partition(": ") for entry in entries):
        name, _, metavar = head.removesuffix(")").partition(" (")
        flagged = re.sub(r"`(\w+)`", lambda word: flag_of(word[1]), text.replace('"', ""))
        found[name] = flagged, metavar or None
    return found
