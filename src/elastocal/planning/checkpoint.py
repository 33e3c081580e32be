"""Where a design stands, on disk: an interrupted run goes on where it was."""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal import __version__
from elastocal.errors import InputError, require
from elastocal.files import atomic_write_bytes, open_input, remove_abandoned

State = Mapping[str, Any]  # arrays and numbers, which become arrays
MARK = "elastocal"  # an array of every file that a stage writes: what has none is not removed
KEY = "[0-9a-f]{32}"


def key_of(files: Iterable[Path], **options: object) -> str:
    """A hash of everything a design depends on: input files, options, the version."""
    digest = hashlib.sha256(__version__.encode())
    for path in files:
        with open_input(path, "input file") as handle:
            digest.update(path.name.encode(errors="surrogateescape") + b"\0")
            digest.update(hashlib.file_digest(handle, "sha256").digest())  # type: ignore[arg-type]
    digest.update(json.dumps(options, sort_keys=True, default=str).encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """What the stages of a design have finished, in a folder beside its output; nowhere if `folder`
    is None.  `check` is called before anything is kept: it raises where work was interrupted.
    `prefix`: of one of several plans that the design searches."""

    folder: Path | None = None
    check: Callable[[], None] = lambda: None
    prefix: str = ""

    @classmethod
    def beside(cls, output: Path, key: str, check: Callable[[], None] = lambda: None) -> Checkpoint:
        """In the folder `OUTPUT.resume`, apart from what other input or options left there.

        Nothing is written, nor anything of another design thrown away, before a stage is saved.
        Raises InputError where something else has that name, or is in the folder.
        """
        folder = output.with_name(output.name + ".resume")
        entries = sorted(folder.iterdir()) if folder.is_dir() else [folder][: folder.exists()]
        for entry in entries:
            require(
                entry.is_dir() and bool(re.fullmatch(KEY, entry.name)),
                f"{entry} is not elastocal's, which keeps in {folder} where a design stands; move "
                "it elsewhere, or name another -o",
            )
        return cls(folder / key[:32], check)

    @property
    def begun(self) -> bool:
        return self.folder is not None and any(self.folder.glob("*.npz"))

    def finished(self, stage: str, make: Callable[[], State]) -> Mapping[str, NDArray]:
        """What was saved of a stage, or else, saved, what `make` returns, as arrays."""
        path = None if self.folder is None else self.folder / f"{self.prefix}{stage}.npz"
        # What cannot be read is made anew.
        with suppress(OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
            if path is not None and path.is_file():
                with open(path, "rb") as file, np.load(file, allow_pickle=False) as saved:
                    return {name: saved[name] for name in saved.files if name != MARK}
        made = {name: np.asarray(value) for name, value in make().items()}
        self.check()
        if path is not None:
            _save(path, made)
        return made

    def drop(self) -> None:
        """This design ends without a plan: nothing to resume, but perhaps of another one."""
        if self.folder is not None:
            _remove(self.folder)

    def clear(self) -> None:
        """The output is written: nothing to resume, whatever else was begun for it."""
        if self.folder is not None:
            for folder in self.folder.parent.glob("*"):
                if re.fullmatch(KEY, folder.name):
                    _remove(folder)


def _save(path: Path, state: Mapping[str, NDArray]) -> None:
    text = io.BytesIO()
    np.savez(text, allow_pickle=False, **{MARK: np.array(__version__)}, **state)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        atomic_write_bytes(path, text.getvalue())
    except InputError:
        if path.parent.is_dir():
            raise
        # Another run of the same design has ended, and cleared the folder that both used.
        _save(path, state)


def _remove(folder: Path) -> None:
    with suppress(OSError):
        remove_abandoned(folder, r".*\.npz")
    for path in folder.glob("*.npz"):
        with suppress(OSError, zipfile.BadZipFile):
            with zipfile.ZipFile(path) as archive:
                ours = f"{MARK}.npy" in archive.namelist()
            if ours:
                path.unlink()
    for empty in (folder, folder.parent):
        with suppress(OSError):
            empty.rmdir()
