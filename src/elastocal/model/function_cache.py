"""CasADi functions by their content, and the user's cache folder for what is made of them."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import sys
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.files import HOW_TO_OPEN, atomic_write_bytes, remove_abandoned

# Finding common subexpressions takes 7 µs per instruction.  It saves 2 to 14 % of the instructions
# of B and 1 % of a Jacobian of 170 000, where it would take longer than all the rest.
LARGEST_REDUCED = 60_000


class HashedFunction:
    """Inputs → outputs as one CasADi function; what is derived from it is made on first use."""

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        self.function = ca.Function("tape", list(inputs), list(outputs))

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """(rows, columns) of every output."""
        f = self.function
        return [f.size_out(k) for k in range(f.n_out())]

    @property
    def sizes(self) -> list[int]:
        """Number of components of every input."""
        return [self.function.nnz_in(k) for k in range(self.function.n_in())]

    @property
    def n_instructions(self) -> int:
        return int(self.function.n_instructions())

    @cached_property
    def digest(self) -> str:
        """sha256 of the expressions themselves and of CasADi's version.

        Chain, cell, effects and whatever else an expression was built from are in it, so what is
        cached under it cannot be stale.
        """
        content = self.function.serialize()
        data = content.encode() if isinstance(content, str) else content
        return hashlib.sha256(casadi_version().encode() + b"\0" + data).hexdigest()

    @property
    def reduced(self) -> ca.Function:
        """The function with every subexpression evaluated once (the given one where it is huge)."""
        # The derivative code repeats the chain's products many times over.
        if self.n_instructions > LARGEST_REDUCED:
            return self.function
        symbols = self.function.sx_in()
        return ca.Function("tape", symbols, self.function.call(symbols), {"cse": True})


def casadi_version() -> str:
    """CasADi's version and the commit it was built from."""
    return f"{ca.CasadiMeta.version()} {ca.CasadiMeta.git_revision()}"


def row_by_row(sparsity: ca.Sparsity) -> list[int]:
    """Where each nonzero, in CasADi's order, stands in its matrix written row by row."""
    columns = sparsity.size2()
    return [r * columns + c for r, c in zip(sparsity.row(), sparsity.get_col(), strict=True)]


# The user's cache folder: entries under a content key that are whole or not there.
#
# What is in it is run as code, with the user's rights.  So the folder must be the user's own and
# nobody else's to enter (mode 0700), and an entry a file of the user's.  An entry is one file
# `KEY.SHA256.SUFFIX`.  Its name holds the digest of its bytes, so a damaged or truncated file is
# noticed before it is used; it appears by one rename, so that of two processes writing the same
# entry each reads a whole one.  No cache is no error: everything in it can be made again.

# Part of every key: raise it when the meaning of an entry changes.
FORMAT = "1"
LARGEST_TOTAL = 200_000_000  # bytes


def content_key(*parts: str | bytes) -> str:
    """32 hex digits of the sha256 over `parts`, their lengths and the cache's format."""
    digest = hashlib.sha256()
    for part in (FORMAT, *parts):
        data = part.encode() if isinstance(part, str) else part
        digest.update(f"{len(data)}:".encode())
        digest.update(data)
    return digest.hexdigest()[:32]


@cache
def written_by(*sources: str) -> str:
    """Digest of the code in these files: part of the key of what it makes."""
    return hashlib.sha256(b"".join(Path(source).read_bytes() for source in sources)).hexdigest()


def cache_folder() -> Path:
    """$ELASTOCAL_CACHE, else the platform's folder for caches; it need not exist."""
    if own := os.environ.get("ELASTOCAL_CACHE"):
        return Path(own).expanduser()
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        base = Path(local) if local else Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        common = os.environ.get("XDG_CACHE_HOME", "")
        # The XDG specification has relative paths ignored.
        base = Path(common) if os.path.isabs(common) else Path.home() / ".cache"
    return base / "elastocal"


# Why a cache folder was refused, in words for the user; the command line says them.
refused: list[str] = []


def usable_folder() -> Path | None:
    """The cache folder, made where it is absent; None where it cannot be written or trusted."""
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if reason := _untrusted(folder):
            told = f"{folder}: compiled code is not kept there, since {reason}"
            if told not in refused:
                refused.append(told)
            return None
        return folder if os.access(folder, os.W_OK | os.X_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return None


def _untrusted(folder: Path) -> str:
    """Why libraries may not be loaded from `folder`, "" where they may."""
    if not hasattr(os, "getuid"):
        return ""
    found = folder.stat()
    if found.st_uid != os.getuid():
        return "the folder is another user's; name one of your own in ELASTOCAL_CACHE"
    if found.st_mode & 0o077:
        return "others may enter the folder; run: chmod 700 on it"
    for above in folder.resolve().parents:
        mode = above.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return f"everybody may replace what is in {above}; run: chmod o-w on it"
    return ""


def entry_bytes(path: Path) -> bytes:
    """The content of an entry.  Raises OSError where it is a link, or no file of the user's."""
    descriptor = os.open(path, os.O_RDONLY | HOW_TO_OPEN)
    with open(descriptor, "rb") as handle:
        found = os.fstat(descriptor)
        own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
        if not stat.S_ISREG(found.st_mode) or not own or found.st_size > LARGEST_TOTAL:
            raise OSError(f"{path} is no entry of this cache")
        return handle.read()


def fetch(key: str, suffix: str) -> Path | None:
    """The whole, undamaged entry of `key`, marked as just used; None where there is none."""
    folder, names = usable_folder(), list[str]()
    if folder is None:
        return None
    with suppress(OSError):  # another process may clear the folder away
        names = os.listdir(folder)
    for name in sorted(n for n in names if n.startswith(f"{key}.") and n.endswith(suffix)):
        path = folder / name
        with suppress(OSError):
            try:
                whole = _digest(entry_bytes(path)) == path.name[len(key) + 1 : -len(suffix)]
            except OSError:
                whole = False
            if whole:
                os.utime(path)
                return path
            path.unlink()
    return None


def fetch_arrays(key: str, suffix: str) -> dict[str, NDArray] | None:
    """The arrays by name of an entry that `store_arrays` wrote; None where there is none."""
    found = fetch(key, suffix)
    if found is None:
        return None
    try:
        with np.load(found, allow_pickle=False) as saved:
            return {name: saved[name] for name in saved.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None  # another process removed it, or it is none of ours


def store_arrays(key: str, suffix: str, arrays: Mapping[str, NDArray]) -> None:
    """Arrays by name as the entry of `key`, where the cache can be written."""
    data = io.BytesIO()
    np.savez(data, **arrays)  # type: ignore[arg-type]
    store(key, suffix, data.getvalue())


def store(key: str, suffix: str, data: bytes) -> Path | None:
    """`data` as the entry of `key`; None where the cache cannot be written."""
    folder = usable_folder()
    if folder is None:
        return None
    path = folder / f"{key}.{_digest(data)}{suffix}"
    try:
        atomic_write_bytes(path, data)
    except InputError:
        return None
    # To look at thousands of entries takes longer than to write one.
    written = _written.get(folder, LARGEST_TOTAL) + len(data)
    if written >= LARGEST_TOTAL * UNPRUNED:
        prune(folder, keep=path)
        written = 0
    _written[folder] = written
    return path


UNPRUNED = 0.02  # share of the cache that a process writes before it looks for what is too much
_written: dict[Path, int] = {}  # bytes by this process since then; at first it looks


def prune(folder: Path, keep: Path, largest: int | None = None) -> None:
    """Remove the least recently used entries beyond `largest` bytes, and abandoned parts."""
    largest = LARGEST_TOTAL if largest is None else largest
    entries = []
    remove_abandoned(folder, r"[0-9a-f]{32}\..{,7}")  # the first 40 letters of an entry's name
    for found in os.scandir(folder):
        with suppress(OSError):
            if found.name == keep.name:
                largest -= found.stat().st_size
            elif _is_entry(found.name):
                facts = found.stat()
                entries.append((facts.st_mtime, facts.st_size, found.path))
    for _, size, path in sorted(entries, reverse=True):
        largest -= size
        if largest < 0:
            with suppress(OSError):
                os.unlink(path)


def _is_entry(name: str) -> bool:
    """Only what `store` wrote may be removed: ELASTOCAL_CACHE may name any folder."""
    key, *others = name.split(".")
    return len(others) >= 2 and len(others[0]) == 64 and bool(re.fullmatch("[0-9a-f]{32}", key))


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
