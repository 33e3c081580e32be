"""Commands of the command line from the signatures of the verbs: an option is declared once.

    @command(verb=verbs.identify, offers="test method noise fixed seed")
    def identify(cell: CellFile, data: DataFile, report: ReportFile, asked: Asked, run: Run): ...

In place of `asked` stand the options that the verb `offers`: name, kind and default are those of
its argument, the help is the first sentence of what its docstring says of that.  In place of `run`
stand the flags that all commands have.  All others are arguments, and where they have a default
options, of the command itself: the help of each stands under Args in its docstring, in brackets
what stands for a value, as in "set_ (KEY=VALUE): Option of the study".
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, get_args

import typer

from elastocal.arguments import LARGEST_SEED, kinds_of
from elastocal.cli.app import app, check_apart, check_outputs, console, reporting_errors
from elastocal.errors import InputError, flag_of
from elastocal.screen import progress_line, say
from elastocal.text import json_text

if TYPE_CHECKING:
    from rich.console import Console

    from elastocal.cell.work_cell import Cell

# What the user asks of a verb: its keyword arguments.
Asked: TypeAlias = dict[str, Any]
# Metavar and meaning of an option that is another thing as a text than in Python.
Texts: TypeAlias = Mapping[str, tuple[str, Callable[[Any], Any]]]

CellFile = Annotated[Path, typer.Argument(help="Cell file (TOML): robot, tool, tracker, model.")]
DataFile = Annotated[Path, typer.Argument(help="Measurements (CSV or Parquet).")]
ResultFile = Annotated[Path, typer.Argument(help="Result of identify -o (JSON).")]
ReportFile = Annotated[Path | None, typer.Option(help="Write a report (one HTML page).")]
PAGES = ".html .htm"  # endings
Output = Annotated[Path, typer.Option("-o", "--output")]
AnyOutput = Annotated[Path | None, typer.Option("-o", "--output")]
JsonFile = Annotated[Path | None, typer.Option("-o", "--output", help="Write the result as JSON.")]
SEED = typer.Option(min=0, max=LARGEST_SEED, help="Seed of all random draws.")
Seed = Annotated[int, SEED]
FLAGS = {
    "plugins": typer.Option(
        "--plugins", help="Run the Python code that the cell names in [plugins]."
    ),
    "json": typer.Option("--json", help="Print the result as JSON to stdout."),
    "quiet": typer.Option("--quiet", "-q", help="No progress."),
}  # fmt: skip
FORCE = tuple[float, float, float]
# What an argument may be in Python → what it is here; of several the first.
TAKEN: dict[str, Any] = {
    "Sequence[str]": list[str], "Path": Path, "str": str, "ArrayLike": FORCE,
    "bool": bool, "int": int, "float": float, "Sequence[int]": str,
}  # fmt: skip


def whole_numbers(text: str, takes: str) -> list[int]:
    """Numbers between commas, for an option that `takes` such."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{takes}; found '{text}'") from None


class Run:
    """One run of a command: what it reads and writes, its progress and its answer."""

    def __init__(self, plugins: bool = False, json: bool = False, quiet: bool = False) -> None:
        self.plugins, self.json, self._quiet = plugins, json, quiet
        self.written: list[Path] = []

    def writes(self, *asked: tuple[Path | None, str]) -> None:
        """The outputs asked for, each with its endings; refused before the work where one cannot
        be written or is named as something else."""
        self.written = check_outputs(*asked)

    def reads(self, *paths: Path | None, cell: Cell | None = None) -> list[Path]:
        """The inputs that are given, none of which, nor a file of the cell, is written over."""
        check_apart(self.written, paths, cell)
        return [path for path in paths if path is not None]

    def progress(self) -> AbstractContextManager[Callable[[str], None]]:
        """Tells on stderr what is done, where the user wants to know."""
        return progress_line(self._quiet)

    def answer(
        self, content: Callable[[], Any], show: Callable[[Console], None], files: bool = True
    ) -> bool:
        """The result as JSON, or shown to people, with the `files` written; True for people."""
        if self.json:
            say(json_text(content()))
            return False
        show(console())
        for path in self.written if files else ():
            say(f"wrote {path}")
        return True


def command(
    *name: str,
    verb: Callable[..., Any] | None = None,
    offers: str = "",
    texts: Texts | None = None,
    flags: str = "plugins json quiet",
    **how: Any,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
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
                parameters += [_parameter(n, bool, False, FLAGS[n]) for n in flags.split()]
            else:
                parameters.append(_own(each, *told.get(each.name, ("", None))))

        @functools.wraps(function)
        def run(**given: Any) -> None:
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
        return app.command(*name, **how)(reporting_errors(run))

    return register


def _offered(
    verb: Callable[..., Any], names: Iterable[str], texts: Texts
) -> Iterator[tuple[str, inspect.Parameter]]:
    """The options of a command for these arguments of a verb."""
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
        yield name, _parameter(name, kind, default, SEED if name == "seed" else option)


def _own(each: inspect.Parameter, help: str, metavar: str | None) -> inspect.Parameter:
    """An argument or option that a command has of itself, with its help."""
    kind, stated = each.annotation, getattr(each.annotation, "__metadata__", ())
    if stated:
        kind, option = get_args(each.annotation)[0], copy(stated[0])
    elif each.default is inspect.Parameter.empty:
        option = typer.Argument()
    else:
        option = typer.Option(flag_of(each.name.rstrip("_")))
    option.help, option.metavar = option.help or help, option.metavar or metavar
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
