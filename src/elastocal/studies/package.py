"""What a worker needs of a study, wherever it stands: its sources and files, and their hash."""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import shutil
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from elastocal import __version__
from elastocal.errors import InputError
from elastocal.studies.definition import Definition

_LOADED: dict[str, ModuleType] = {}
_FOLDERS: set[Path] = set()
_LOCK = threading.Lock()


@dataclass(frozen=True)
class Package:
    """The .py files of a study's folder and the files that study.toml names, by their names.

    Sent to each worker: one that has the same folder with the same contents uses it there, any
    other unpacks this one, so a cluster needs no shared file system.
    """

    folder: Path
    contents: Mapping[str, bytes]
    columns: Mapping[str, str]
    version: str = __version__

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 by file name."""
        return {name: hashlib.sha256(data).hexdigest() for name, data in self.contents.items()}

    @property
    def digest(self) -> str:
        """One SHA-256 of all names and contents."""
        lines = [f"{name} {value}" for name, value in sorted(self.digests.items())]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def pack(definition: Definition) -> Package:
    """The package of a study as its folder stands now."""
    folder = definition.folder.resolve()
    names = {path.relative_to(folder) for path in folder.rglob("*.py")}
    scripts = {n.as_posix() for n in names if not any(_hidden(part) for part in n.parts)}
    contents = {n: (folder / n).read_bytes() for n in sorted(scripts | set(definition.files))}
    return Package(folder, contents, definition.columns)


def _hidden(part: str) -> bool:
    return part.startswith(".") or part == "__pycache__"


def load(package: Package, digest: str) -> ModuleType:
    """The module study.py, imported once per process and `digest`.

    Raises InputError with file and line where importing it fails.
    """
    with _LOCK:
        if digest not in _LOADED:
            folder = package.folder if _same(package) else _unpack(package)
            _forget()
            _FOLDERS.add(folder)
            sys.path.insert(0, str(folder))
            _LOADED[digest] = calling(folder, "importing study.py", lambda: _import(folder, digest))
        return _LOADED[digest]


def _import(folder: Path, digest: str) -> ModuleType:
    name = f"elastocal_study_{digest[:16]}"
    spec = importlib.util.spec_from_file_location(name, folder / "study.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look a class's module up by its name
    spec.loader.exec_module(module)
    return module


def _same(package: Package) -> bool:
    """Whether the folder stands on this machine with the package's very contents."""
    try:
        return all(
            (package.folder / name).read_bytes() == data for name, data in package.contents.items()
        )
    except OSError:
        return False


def _unpack(package: Package) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="elastocal-study-")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, data in package.contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder


def _forget() -> None:
    """Drop what other studies, or an earlier state of this one, imported from their folders.

    A worker outlives a study, and two studies may both have a scenarios.py.
    """
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        own = name.startswith("elastocal_study_")
        if file and not own and any(Path(file).is_relative_to(folder) for folder in _FOLDERS):
            del sys.modules[name]
    for folder in _FOLDERS:
        while str(folder) in sys.path:
            sys.path.remove(str(folder))
    importlib.invalidate_caches()


def calling(folder: Path, what: str, call: Callable[[], Any]) -> Any:
    """The value of `call`, which is code of the study in `folder`.

    Raises InputError that names the study's file and line where it raises anything.
    """
    try:
        return call()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        file, line = _blamed(error, folder)
        raise InputError(
            f"{file}, line {line}: {what} raised {type(error).__name__}: {error}; correct it there"
        ) from error


def _blamed(error: BaseException, folder: Path) -> tuple[str, int]:
    """The last line of the study's own files that led to the error."""
    if isinstance(error, SyntaxError) and error.filename:
        return error.filename, error.lineno or 1
    frames: Iterable[traceback.FrameSummary] = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if Path(f.filename).is_relative_to(folder)]
    return (own[-1].filename, own[-1].lineno or 1) if own else (str(folder / "study.py"), 1)
