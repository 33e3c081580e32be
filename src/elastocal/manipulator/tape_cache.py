"""The user's cache folder: entries under a content key that are whole or not there.

An entry is one file `KEY.SHA256.SUFFIX`.  Its name holds the digest of its bytes, so a damaged or
truncated file is seen before it is used, and it appears by one rename, so that of two processes
writing the same entry each reads a whole one.  No cache is no error: everything in it can be
made again.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import time
from contextlib import suppress
from pathlib import Path

from elastocal.errors import InputError
from elastocal.files import UNFINISHED, atomic_write_bytes

# Part of every key: raise it when the meaning of an entry changes.
FORMAT = "1"
LARGEST_TOTAL = 200_000_000  # bytes
ABANDONED = 3600.0  # s; a temporary file this old belongs to a process that died


def content_key(*parts: str | bytes) -> str:
    """32 hex digits of the sha256 over `parts`, their lengths and the cache's format."""
    digest = hashlib.sha256()
    for part in (FORMAT, *parts):
        data = part.encode() if isinstance(part, str) else part
        digest.update(f"{len(data)}:".encode())
        digest.update(data)
    return digest.hexdigest()[:32]


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


def usable_folder() -> Path | None:
    """The cache folder, made where it is absent; None where it cannot be written.

    A folder of somebody else's is not used: libraries are loaded from it.
    """
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return None
        return folder if os.access(folder, os.W_OK | os.X_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return None


def fetch(key: str, suffix: str) -> Path | None:
    """The whole, undamaged entry of `key`, marked as just used; None where there is none."""
    folder = usable_folder()
    if folder is None:
        return None
    for path in sorted(folder.glob(f"{key}.*{suffix}")):
        with suppress(OSError):
            if _digest(path.read_bytes()) == path.name[len(key) + 1 : -len(suffix)]:
                os.utime(path)
                return path
            path.unlink()
    return None


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
    prune(folder, keep=path)
    return path


def prune(folder: Path, keep: Path, largest: int | None = None) -> None:
    """Remove the least recently used entries beyond `largest` bytes, and abandoned parts."""
    largest = LARGEST_TOTAL if largest is None else largest
    entries = []
    for path in folder.iterdir():
        with suppress(OSError):
            facts = path.stat()
            if path.suffix == UNFINISHED and _is_key(path.name[1:33]):
                if time.time() - facts.st_mtime > ABANDONED:
                    path.unlink()
            elif _is_entry(path) and path != keep:
                entries.append((facts.st_mtime, facts.st_size, path))
            elif path == keep:
                largest -= facts.st_size
    for _, size, path in sorted(entries, reverse=True):
        largest -= size
        if largest < 0:
            with suppress(OSError):
                path.unlink()


def _is_entry(path: Path) -> bool:
    """Only what `store` wrote may be removed: ELASTOCAL_CACHE may name any folder."""
    parts = path.name.split(".")
    return len(parts) >= 3 and _is_key(parts[0]) and len(parts[1]) == 64


def _is_key(text: str) -> bool:
    return re.fullmatch("[0-9a-f]{32}", text) is not None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
