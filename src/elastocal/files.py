"""Files at the edge: the one reader of input files, and writing that never leaves half a file.

Every input is sized before it is read, and only regular files are: a pipe would be waited for
without end, and a device such as /dev/zero has no end.

Code of the user's own comes from here too.  A plug-in is any Python code that calls
`elastocal.plugins.register_effect` and its like.  It is run once.  An entry point of the group
`elastocal.plugins`, which somebody installed, runs when the first model is made.  What `[plugins]
modules` of a cell names came with the cell, perhaps from a stranger, and runs only when the user
says so.
"""

from __future__ import annotations

import json
import math
import os
import re
import secrets
import signal
import stat
import sys
import threading
import traceback
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

from elastocal.messages import SHOWN, InputError, listed, option, quoted, raised_at, require

# What is being written ends so, after the number of the process that writes it.
UNFINISHED = ".tmp"
# Elements within each other, and parts of a dotted key: a file that people write has six.
DEEPEST = 32
LONGEST_INTEGER = 18  # digits; a longer one is read as a float


def check_regular(path: str | Path, what: str, max_bytes: int | None = None) -> None:
    """An existing regular file of at most `max_bytes`; `what` names it in messages."""
    _check_path(path)
    with _read_errors(path, what):
        found = os.stat(path)
        kind = KINDS.get(stat.S_IFMT(found.st_mode), "device")
        told = f"is a {kind}, not a regular file; save the {what} to disk first"
        require(kind != "directory", f"{path}: is a directory; give the {what} itself")
        require(kind == "file", f"{path}: {told}")
    check_size(path, what, found.st_size, max_bytes)


KINDS = {
    stat.S_IFREG: "file", stat.S_IFDIR: "directory", stat.S_IFIFO: "pipe (FIFO)",
    stat.S_IFSOCK: "socket",
}  # fmt: skip
# What is read by place → endings that tell of a file in another's place.
OTHERS = {
    "cell file": (".csv", ".tsv", ".parquet", ".pq", ".json"),
    "measurement table": (".toml",),
    "result of identify": (".toml",),
}


@contextmanager
def open_input(path: str | Path, what: str, max_bytes: int | None = None) -> Iterator[BinaryIO]:
    told = f"the {what} is given by its path; found {type(path).__name__}"
    require(isinstance(path, str | Path), told)
    ending = Path(path).suffix.lower()
    if ending in OTHERS.get(what, ()):  # arguments stand in each other's place
        raise InputError(
            f"{path}: ends in {ending}, where the {what} is to stand; the cell file (.toml) comes "
            "first, tables and results after it"
        )
    check_regular(path, what, max_bytes)
    with _read_errors(path, what), open(path, "rb") as handle:
        yield handle


def check_size(path: str | Path, what: str, size: int, max_bytes: int | None) -> None:
    if max_bytes is not None and size > max_bytes:
        raise InputError(
            f"{path}: larger than {max_bytes / 1e6:g} MB, which no {what} is; check the path"
        )


@contextmanager
def _read_errors(path: str | Path, what: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path of the {what}") from None
    except PermissionError:
        raise InputError(f"{path}: no permission to read the {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def read_bytes(path: str | Path, what: str, max_bytes: int) -> bytes:
    with open_input(path, what, max_bytes) as handle:
        data = handle.read()
    check_size(path, what, len(data), max_bytes)  # those of /proc tell no size before
    return data


def read_text(path: str | Path, what: str, max_bytes: int) -> str:
    """Of a UTF-8 file; a byte order mark is dropped."""
    return decoded(str(path), read_bytes(path, what, max_bytes), f"save the {what} as UTF-8")


def read_json(path: str | Path, what: str, max_bytes: int, remedy: str) -> Any:
    """Strict JSON; whole numbers too long for it become floats.  What is wrong is told with the
    line, where there is one, and the `remedy`."""
    text = read_text(path, what, max_bytes)

    def number(digits: str) -> float:
        if not math.isfinite(value := float(digits)):
            raise ValueError(f"{digits[:SHOWN]} is no number of JSON")
        return value

    def whole(digits: str) -> int | float:
        return int(digits) if len(digits) <= LONGEST_INTEGER else number(digits)

    try:
        return json.loads(text, parse_int=whole, parse_float=number, parse_constant=number)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not JSON ({error.msg}); {remedy}") from None
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); {remedy}") from None
    except RecursionError:
        raise InputError(f"{path}: lists within lists without end; {remedy}") from None


def read_record(path: Path, max_bytes: int = 200_000_000) -> dict[str, Any]:
    """What a command wrote of its run; empty where that is damaged or not there."""
    with suppress(InputError):
        if isinstance(found := read_json(path, "record", max_bytes, ""), dict):
            return found
    return {}


def decoded(
    source: str, data: bytes, remedy: str, codec: str = "utf-8-sig", name: str = "UTF-8",
    line: int = 1,
) -> str:  # fmt: skip
    """The text of `data`, which begins in `line` of a file; `name` is what people call the encoding
    `codec`, `remedy` what they can do."""
    try:
        return data.decode(codec)
    except UnicodeDecodeError as error:
        line += data.count(b"\n", 0, error.start)
        raise InputError(
            f"{source}, line {line}: not {name} text (byte 0x{data[error.start]:02x}); {remedy}"
        ) from None


def check_exists(path: Path, key: str) -> Path:
    """`path`, which the `key` of a cell names, where it is an existing file."""
    try:
        check_regular(path, "file")
    except InputError as error:
        raise InputError(f"{key} names {error}; paths are relative to the cell file") from None
    return path


def _check_path(path: str | Path) -> None:
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: no file can have this name; check the path")


def apart(outputs: Iterable[str | Path], inputs: Iterable[str | Path]) -> None:
    # Not Path.resolve, which raises RuntimeError where links go round in a circle.
    read, taken = {*map(os.path.realpath, inputs)}, set[str]()
    for path in outputs:
        real = os.path.realpath(path)
        require(real not in read, f"{path} is read and would be written over; name another output")
        require(real not in taken, f"{path}: two outputs of the same name; name another one")
        taken.add(real)


def check_output(path: str | Path, endings: Collection[str] = ()) -> None:
    """Raise InputError where no file can be written under `path`, or its ending is that of
    something else; a name without one may stand for anything."""
    _check_path(path)
    told = f"{path} reads like an option; name the file to write (./{path} if it is called so)"
    require(not str(path).startswith("-"), told)
    folder, ending = Path(path).absolute().parent, Path(path).suffix.lower()
    require(not os.path.isdir(path), f"{path} is a directory; name a file to write")
    if not _is_device(path):
        told = f"{path}: the folder {folder} does not exist; create it first"
        require(os.path.isdir(folder), told)
        require(os.access(folder, os.W_OK), f"{path}: no permission to write in {folder}")
    if ending and endings and ending not in endings:
        raise InputError(
            f"{path}: ends in {ending}; this output is written as {' or '.join(endings)}, "
            "name it so"
        )


def _is_device(path: str | Path) -> bool:
    return os.path.exists(path) and not os.path.isfile(path)


# What is written within `together`, by its temporary file; None outside.
_written: list[tuple[Path, Path]] | None = None


@contextmanager
def together() -> Iterator[None]:
    """Files that are written within it appear at its end, all of them; where it fails none does,
    and what stood there before is untouched."""
    global _written
    _written = written = list[tuple[Path, Path]]()
    try:
        yield
        with _undisturbed():
            for temporary, target in written:
                with _write_errors(target):
                    os.replace(temporary, target)
    finally:
        _written = None
        for temporary, _ in written:
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_writer(path: str | Path, binary: bool = False) -> Iterator[Any]:
    """A handle (text in UTF-8) whose content appears under `path` only when all of it is written;
    whatever fails leaves no temporary file, and the old content of `path` untouched."""
    check_output(path)
    mode = "b" if binary else ""
    how: dict[str, Any] = {} if binary else {"encoding": "utf-8", "newline": "\n"}
    target = Path(os.path.realpath(path))  # a link keeps pointing to what it points to
    with _write_errors(path):
        if _is_device(path):  # renaming over /dev/stdout or /dev/null would replace the device
            with open(path, f"w{mode}", **how) as device:
                yield device
            return
        with suppress(OSError):
            remove_abandoned(target.parent, re.escape(target.name[:40]))
        own = f"{os.getpid()}-{secrets.token_hex(4)}"
        temporary = target.with_name(f".{target.name[:40]}.{own}{UNFINISHED}")
        try:
            with open(temporary, f"x{mode}", **how) as handle:
                if target.exists():  # what others may not read they may not read afterwards
                    os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
                yield handle
                handle.flush()
                os.fsync(handle.fileno())
            if _written is None:
                os.replace(temporary, target)
            else:
                _written.append((temporary, target))
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise


@contextmanager
def _write_errors(path: str | Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None


def atomic_write(path: str | Path, content: str | bytes) -> None:
    with atomic_writer(path, isinstance(content, bytes)) as handle:
        handle.write(content)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """In a `with` block Ctrl-C is noted, and takes effect at its end."""
    before, noted = signal.getsignal(signal.SIGINT), list[int]()
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, lambda number, frame: noted.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if noted:
        before(signal.SIGINT, None)


def remove_abandoned(folder: Path, name: str) -> None:
    """Remove what killed processes left in `folder` of files whose names match the pattern `name`:
    regular files named as unfinished ones are, whose process runs no longer."""
    known = re.compile(rf"\.{name}\.(\d+)-[0-9a-f]{{8}}{re.escape(UNFINISHED)}", re.DOTALL)
    for path in folder.iterdir():
        found = known.fullmatch(path.name)
        if found and stat.S_ISREG(path.lstat().st_mode) and not _runs(int(found[1])):
            path.unlink()


def _runs(process: int) -> bool:
    try:
        if os.name == "posix":  # elsewhere the signal 0 would end it
            os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass  # somebody else's
    return True


GROUP = "elastocal.plugins"
MAX_BYTES = 1_000_000
OURS = str(Path(__file__).parent)
TRUSTED = "ELASTOCAL_PLUGINS"  # 1, or folders whose cells may have their plug-ins run

RAN: dict[Path, bytes] = {}  # files that were run, as they were then
REGISTERED: set[type] = set()  # the classes of effects, noise models and criteria that they gave


def load_plugins(
    cell: Path | None = None, modules: Sequence[str] = (), asked: bool = True, fresh: bool = True
) -> None:
    """Run the plug-ins of installed packages, and the `modules` that the file `cell` names: paths
    of files (.py) or modules that can be imported.  What has been run is not run again, but where
    `fresh` for a file that has changed.  `asked`: whether the user said that they may run, as the
    environment variable TRUSTED says of folders."""
    load_installed()
    owner, said = cell or Path("plug-ins"), option("plugins", True)
    said = said if said.startswith("--") else f"ec.Model(..., {said})"
    for k, name in enumerate(modules):
        if _has_run(name, fresh):
            continue
        key = f"{owner}: key plugins.modules[{k}]"
        what = f"the Python file {name}" if is_plugin_file(name) else f"the module {name!r}"
        require(
            asked or _trusted(owner),
            f"{key} names {what}, which runs with your rights and so not unasked; "
            f"read it, then say {said}, or set {TRUSTED}="
            f"{owner.absolute().parent} for all cells of this folder",
        )
        if is_plugin_file(name):
            _run_file(check_exists(Path(name), key), key)
        else:
            with _running(key):
                _import(name)


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
    return path in RAN and not (fresh and path.exists() and RAN[path] != path.read_bytes())


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
    """Once in a process: looking for them reads what every package says of itself."""
    from importlib.metadata import entry_points

    for point in entry_points(group=GROUP):
        source = f" of the package {point.dist.name}" if point.dist else ""
        with _running(f"plug-in '{point.name}'{source}"):
            found = point.load()
            if not isinstance(found, ModuleType):  # a module registers when it is imported
                found()


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

    path = path.resolve()
    source = read_bytes(path, "plug-in", MAX_BYTES)
    # No file is written beside the user's own, as an import would.
    module = ModuleType(f"plugin_{path.stem}_{zlib.crc32(str(path).encode()):08x}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    with _running(where, str(path)):
        exec(compile(source, str(path), "exec"), module.__dict__)
    RAN[path] = source


@contextmanager
def _running(where: str, path: str = "") -> Iterator[None]:
    """What a plug-in raises is told with the last line of its file `path`, or of any not ours."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:
        found = raised_at(error, lambda f: f == path)
        foreign = raised_at(error, lambda f: not f.startswith((OURS, "<frozen")))
        file, line = found or foreign or ("", 0)
        text = f"{type(error).__name__}: {error.msg if isinstance(error, SyntaxError) else error}"
        raise InputError(f"{where}: {file}, line {line}: {text}; correct the plug-in") from error


# Set, the command line shows the traceback of what no message foresees.
TRACEBACK = "ELASTOCAL_TRACEBACK"
INTERNAL = 70  # what sysexits.h calls a fault of the software


def explained(error: Exception, read: Iterable[object]) -> tuple[str, int]:
    """What a library raised as a sentence that names the files `read`, and the exit code.  Memory
    that ends and numbers that cannot be computed with come from the input; whatever else code of
    elastocal raises is a fault of its own, and asked to be reported."""
    what = f"{type(error).__name__}: {error}".rstrip(": ")
    if plugin := _of_plugin(error):
        return f"{plugin}: {what}; correct the plug-in", 2
    named = [str(p) for p in read if p is not None for p in (p if isinstance(p, list) else [p])]
    files, (file, line) = listed(named) or "the options", raised_at(error, bool) or ("", 0)
    numbers = isinstance(error, ArithmeticError) or type(error).__name__ == "LinAlgError"
    if isinstance(error, MemoryError):
        told = f"memory ends ({what}); give fewer readings, or ask for less by the options"
    elif numbers or (isinstance(error, ValueError | RuntimeError) and not file.startswith(OURS)):
        told = (
            f"holds numbers, or options give some, that cannot be computed with ({what}); look for "
            "values far too large or too small, or in another unit"
        )
    else:
        told = (
            f"not foreseen: {what} at {Path(file).name}, line {line}. Please report this fault of "
            f"elastocal with the command and its files ({TRACEBACK}=1 shows where)"
        )
        return f"{files}: {told}", INTERNAL
    return f"{files}: {told}", 1


def _of_plugin(error: Exception) -> str:
    """Where a plug-in raised `error`, or what it gave did; else empty."""
    ran = set(map(str, RAN))
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file, mine = frame.f_code.co_filename, frame.f_locals.values()
        kinds = [v if isinstance(v, type) else type(v) for v in mine]
        for plugin in (kind for kind in kinds if kind in REGISTERED):
            home = getattr(sys.modules.get(plugin.__module__), "__file__", file)
            at = f"{home}, line {line}" if file == home else home
            return f"{at}: '{getattr(plugin, 'name', plugin.__name__)}'"
        if file in ran:
            return f"{file}, line {line}"
    return ""


def check_registered(thing: object, base: type, what: str, example: str) -> None:
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
