"""Where code of the user's own comes from: installed packages, and files that a cell names.

A plug-in is any Python code that calls `elastocal.plugins.register_effect` and its like.  It is run
once.  An entry point of the group `elastocal.plugins`, which somebody installed, runs when the
first model is made.  What `[plugins] modules` of a cell names came with the cell, perhaps from a
stranger, and runs only when the user says so.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from elastocal.files import check_exists, read_text
from elastocal.messages import InputError, option, quoted, raised_at, require

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "elastocal.plugins"
MAX_BYTES = 1_000_000
OURS = str(Path(__file__).parent)
TRUSTED = "ELASTOCAL_PLUGINS"  # 1, or folders whose cells may have their plug-ins run

_files: dict[Path, tuple[int, int]] = {}  # files that were run, as they were then
REGISTERED: set[type] = set()  # the classes of effects, noise models and criteria that they gave


def load_plugins(
    cell: Path | None = None, modules: Sequence[str] = (), asked: bool = True, fresh: bool = True
) -> None:
    """Run the plug-ins of installed packages, and the `modules` that the file `cell` names.

    A name that ends with .py is the path of a file; any other is a module that can be imported.
    What has been run is not run again, but where `fresh` for a file that has changed.  `asked`:
    whether the user said that they may run, as the environment variable TRUSTED says of folders.

    Raises InputError that names the plug-in, its file and the line, where one cannot be run.
    """
    load_installed()
    owner = cell or Path("plug-ins")
    for k, name in enumerate(modules):
        if _has_run(name, fresh):
            continue
        key, path = f"plugins.modules[{k}]", Path(name) if is_plugin_file(name) else None
        what = f"the module {name!r}" if path is None else f"the Python file {path}"
        require(
            asked or _trusted(owner),
            f"{owner}: key {key} names {what}, which runs with your rights and so not unasked; "
            f"read it, then say {option('plugins', True)}, or set {TRUSTED}="
            f"{owner.absolute().parent} for all cells of this folder",
        )
        where = f"{owner}: key {key}"
        if path is None:
            _run(where, None, partial(_import, name))
        else:
            _run_file(check_exists(path, key, owner), where)


class Carried:
    """The plug-ins of a cell that ran here; whoever opens its pickle runs them there too."""

    def __init__(self, cell: Path, modules: Sequence[str]) -> None:
        self.cell = cell
        self.modules = tuple(
            str(Path(name).resolve()) if is_plugin_file(name) else name
            for name in modules
            if _has_run(name, False)
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return load_plugins, (self.cell, self.modules, True, False)


def _has_run(name: str, fresh: bool) -> bool:
    if not is_plugin_file(name):
        return name in sys.modules
    path = Path(name).resolve()
    return path in _files and not (fresh and path.exists() and _files[path] != _version(path))


def _trusted(cell: Path) -> bool:
    stated = os.environ.get(TRUSTED, "")
    folders = (Path(each).resolve() for each in stated.split(os.pathsep) if os.path.isabs(each))
    return stated == "1" or any(cell.resolve().is_relative_to(folder) for folder in folders)


def is_plugin_file(module: str) -> bool:
    return module.endswith(".py")


def load_installed() -> None:
    _load_installed_in(tuple(sys.path))


@cache
def _load_installed_in(folders: tuple[str, ...]) -> None:
    """Of packages in these folders: looking for them reads what every package says of itself, so it
    is done once in a process."""
    from importlib.metadata import entry_points

    for point in entry_points(group=GROUP):
        source = f" of the package {point.dist.name}" if point.dist else ""

        def enter(point: EntryPoint = point) -> None:
            """A module registers when it is imported, a function when it is called."""
            found = point.load()
            if not isinstance(found, ModuleType):
                found()

        _run(f"plug-in '{point.name}'{source}", None, enter)


def _import(name: str) -> None:
    import importlib

    if not re.fullmatch(r"\w+(\.\w+)*", name):
        raise InputError(
            f'a plug-in is a file that ends with .py, as "my_effects.py", or a module, as '
            f'"my_package.effects"; found {quoted(name)}'
        )
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):
            raise
        raise InputError(
            f"there is no module '{error.name}'; install its package, or name a file that ends "
            "with .py"
        ) from None


def _run_file(path: Path, where: str) -> None:
    import zlib

    try:
        from cloudpickle import register_pickle_by_value
    except ImportError:  # joblib before 1.6 carries its own
        from joblib.externals.cloudpickle import register_pickle_by_value

    path = path.resolve()
    version = _version(path)
    source = read_text(path, "plug-in", MAX_BYTES)
    # No file is written beside the user's own, as an import would.
    module = ModuleType(f"plugin_{path.stem}_{zlib.crc32(str(path).encode()):08x}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module

    try:
        _run(where, path, lambda: exec(compile(source, str(path), "exec"), module.__dict__))
    except InputError:
        del sys.modules[module.__name__]
        raise
    register_pickle_by_value(module)  # workers, which have not run it, are sent its classes
    _files[path] = version


def _version(path: Path) -> tuple[int, int]:
    state = path.stat()
    return state.st_mtime_ns, state.st_size


def _run(where: str, path: Path | None, run: Callable[[], None]) -> None:
    try:
        run()
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:
        found = raised_at(error, lambda f: f == str(path))
        foreign = raised_at(error, lambda f: not f.startswith((OURS, "<frozen")))
        file, line = found or foreign or ("", 0)
        text = f"{type(error).__name__}: {error.msg if isinstance(error, SyntaxError) else error}"
        raise InputError(f"{where}: {file}, line {line}: {text}; correct the plug-in") from error


# What may be registered, whatever it is.


def check_registered(thing: object, base: type, what: str, example: str) -> None:
    """InputError unless `thing` is an object of a class derived from `base`, with a name."""
    if isinstance(thing, type) and issubclass(thing, base):
        raise InputError(f"register {what}, {thing.__name__}(), not its class")
    kind = type(thing)
    told = f"{what} is an object of a class derived from {base.__name__}; found {kind.__name__}"
    require(isinstance(thing, base), told)
    name = getattr(thing, "name", None)
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(
            f"{kind.__name__}.name takes lower-case letters, digits and underscores, as in "
            f'"{example}"; found {name!r}'
        )


def same_class(known: object, new: object) -> bool:
    """Whether both are, or were made by, one class, perhaps defined anew in a notebook."""
    a, b = (thing if isinstance(thing, type) else type(thing) for thing in (known, new))
    return (a.__module__, a.__qualname__) == (b.__module__, b.__qualname__)
