"""Where a design stands, on disk: an interrupted run goes on where it was."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal import __version__
from elastocal.errors import require
from elastocal.files import atomic_write, open_input

State = Mapping[str, Any]  # arrays and numbers, which become arrays
KEY = "elastocal"  # the array that says of which design a file is


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
    """What the stages of a design have finished, `kept` as arrays STAGE/NAME and in a file beside
    its output; nowhere if `path` is None.  `prefix`: of one of several plans that the design
    searches."""

    path: Path | None = None
    prefix: str = ""
    kept: dict[str, NDArray] = field(default_factory=dict)

    @classmethod
    def beside(cls, output: Path, key: str) -> Checkpoint:
        """In the file `OUTPUT.resume`, which other input or options begin anew, once they have
        something to keep.  Raises InputError where something else has that name."""
        path, kept = output.with_name(output.name + ".resume"), {KEY: np.array(key)}
        if path.exists():
            saved: dict[str, NDArray] = {}
            failures = OSError, ValueError, EOFError, zipfile.BadZipFile
            with suppress(*failures), open(path, "rb") as file, np.load(file) as arrays:
                saved = dict(arrays)
            require(
                KEY in saved,
                f"{path} is not elastocal's, which keeps there where a design stands; move it "
                "elsewhere, or name another -o",
            )
            kept = saved if str(saved[KEY]) == key else kept
        return cls(path, kept=kept)

    @property
    def begun(self) -> bool:
        return len(self.kept) > 1

    def finished(self, stage: str, make: Callable[[], State]) -> Mapping[str, NDArray]:
        """What was kept of a stage, or else, kept now, what `make` returns, as arrays."""
        name = f"{self.prefix}{stage}/"
        own = {at.removeprefix(name): kept for at, kept in self.kept.items() if at.startswith(name)}
        if own:
            return own
        made = {at: np.asarray(value) for at, value in make().items()}
        if self.path is None:
            return made
        self.kept.update({name + at: value for at, value in made.items()})
        text = io.BytesIO()
        np.savez(text, allow_pickle=False, **self.kept)
        atomic_write(self.path, text.getvalue())
        return made

    def clear(self) -> None:
        """The design has ended: there is nothing to resume."""
        if self.path is not None and self.begun:
            self.path.unlink(missing_ok=True)
