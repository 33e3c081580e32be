"""Where a design stands, on disk: an interrupted run goes on where it was."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from elastocal import __version__
from elastocal.errors import InputError
from elastocal.files import atomic_write_bytes, open_input

State = Mapping[str, NDArray]


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
class Stage:
    """What one stage of a design has finished so far; nowhere kept if `path` is None.

    `check` is called before anything is kept: it raises where the work was interrupted.
    """

    path: Path | None
    check: Callable[[], None] = lambda: None

    def load(self) -> dict[str, NDArray] | None:
        """What was saved last, None if nothing (readable) was."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as saved:
                return {name: saved[name] for name in saved.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def finished(self, make: Callable[[], State]) -> State:
        """What was saved, or else what `make` returns, saved."""
        saved = self.load()
        if saved is not None:
            return saved
        self.save(made := make())
        return made

    def save(self, state: State) -> None:
        """Keep `state`, whole or not at all."""
        self.check()
        if self.path is None:
            return
        text = io.BytesIO()
        np.savez(text, allow_pickle=False, **{k: np.asarray(v) for k, v in state.items()})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            atomic_write_bytes(self.path, text.getvalue())
        except InputError:
            if self.path.parent.is_dir():
                raise
            # Another run of the same design has ended, and cleared the folder that both used.
            self.save(state)


@dataclass(frozen=True)
class Checkpoint:
    """The stages of one design, in a folder beside its output; nowhere if `folder` is None."""

    folder: Path | None = None
    check: Callable[[], None] = lambda: None

    @classmethod
    def beside(cls, output: Path, key: str, check: Callable[[], None] = lambda: None) -> Checkpoint:
        """In the folder `OUTPUT.resume`, apart from what other input or options left there.

        Nothing is written, nor anything of another design thrown away, before a stage is saved.
        """
        return cls(output.with_name(output.name + ".resume") / key[:32], check)

    @property
    def begun(self) -> bool:
        """Is there anything to go on from?"""
        return self.folder is not None and any(self.folder.glob("*.npz"))

    def stage(self, name: str) -> Stage:
        path = None if self.folder is None else self.folder / f"{name}.npz"
        return Stage(path, self.check)

    def drop(self) -> None:
        """This design ends without a plan: nothing to resume, but perhaps of another one."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            with suppress(OSError):
                self.folder.parent.rmdir()

    def clear(self) -> None:
        """The output is written: nothing to resume, whatever else was begun for it."""
        if self.folder is not None:
            shutil.rmtree(self.folder.parent, ignore_errors=True)
