"""A tape as compiled C: its library found in the cache or compiled, loaded, and called on rows."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import secrets
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator import backend_function, compiled_source
from elastocal.manipulator.backend_function import TapeFunction, casadi_version
from elastocal.manipulator.compiled_build import (
    FLAGS,
    LIBRARIES,
    SUFFIX,
    Compiler,
    NoCompiler,
    compile_library,
    find_compiler,
)
from elastocal.manipulator.tape_cache import content_key, fetch, store


class Compiled:
    """A library's rows: `evaluate` fills whole blocks of rows without returning to Python.

    It takes float64 arrays only.  The call releases the interpreter's lock.
    """

    def __init__(self, library: Path, compiler: Compiler, cached: bool) -> None:
        self.compiler, self.cached = compiler, cached
        loaded = ctypes.CDLL(str(library))
        loaded.elastocal_work.restype = ctypes.c_longlong
        self._work = int(loaded.elastocal_work())
        self._rows = loaded.elastocal_rows
        pointer = ctypes.c_void_p
        self._rows.argtypes = [ctypes.c_longlong, ctypes.c_longlong, *[pointer] * 4]
        self._rows.restype = None

    def evaluate(
        self, inputs: Sequence[NDArray], results: Sequence[NDArray], blocks: Sequence[slice]
    ) -> None:
        """Rows of `blocks` of the C-contiguous `results` (n, rows, columns)."""
        arrays = [_rows_contiguous(a) for a in inputs]
        strides = [a.strides[0] // a.itemsize if a.ndim == 2 else 0 for a in arrays]
        ins = (ctypes.c_void_p * len(arrays))(*[a.ctypes.data for a in arrays])
        steps = (ctypes.c_longlong * len(arrays))(*strides)
        outs = (ctypes.c_void_p * len(results))(*[r.ctypes.data for r in results])
        work = np.empty(self._work)
        for block in blocks:
            self._rows(block.start, block.stop, ins, steps, outs, work.ctypes.data)


def _rows_contiguous(a: NDArray) -> NDArray:
    """`a` with the numbers of a row side by side, at whole multiples of their size."""
    good = a.size and a.strides[-1] == a.itemsize and a.strides[0] % a.itemsize == 0
    return a if good and a.flags.aligned else np.ascontiguousarray(a)


def find_compiled(function: TapeFunction) -> Compiled | None:
    """The library of `function` where one is cached and loads.

    Raises NoCompiler without a compiler.
    """
    compiler = find_compiler()
    library = fetch(_key(function, compiler), SUFFIX)
    if library is None:
        return None
    try:
        return _loaded(library, compiler, cached=True)
    except NoCompiler:  # whole, but not for this system
        with suppress(OSError):
            library.unlink()
        return None


def compile_tape(function: TapeFunction) -> Compiled:
    """The library of `function`, from the cache or compiled now.

    Raises NoCompiler where there is no compiler or it fails.
    """
    compiler = find_compiler()
    if found := find_compiled(function):
        return found
    try:
        source = compiled_source.c_source(function.reduced)
    except compiled_source.UnknownCode as error:
        raise NoCompiler(
            f"CasADi {casadi_version()} writes C that is not known here ({error})"
        ) from None
    data = compile_library(compiler, source)
    library = store(_key(function, compiler), SUFFIX, data)
    if library is not None:
        return _loaded(library, compiler, cached=False)
    # Without a cache the file is needed only until it is loaded, where the system allows that.
    with tempfile.TemporaryDirectory(prefix="elastocal-", ignore_cleanup_errors=True) as folder:
        library = Path(folder, f"tape-{secrets.token_hex(8)}{SUFFIX}")
        library.write_bytes(data)
        return _loaded(library, compiler, cached=False)


def _loaded(library: Path, compiler: Compiler, cached: bool) -> Compiled:
    try:
        return Compiled(library, compiler, cached)
    except (OSError, AttributeError) as error:
        raise NoCompiler(f"the library that {compiler} made cannot be loaded ({error})") from None


def _key(function: TapeFunction, compiler: Compiler) -> str:
    """Everything the library is made from: expressions, C text's author, compiler, flags, system.

    The C text follows from the expressions, CasADi's version and the code here; hashing these
    spares generating it.
    """
    flags = (*compiler.command, compiler.version, *FLAGS, *LIBRARIES)
    system = (sys.platform, platform.machine(), *platform.libc_ver())
    return content_key("library", function.digest, _written_by(), *flags, *system)


@cache
def _written_by() -> str:
    """Digest of the code that writes the C text."""
    sources = [Path(compiled_source.__file__), Path(backend_function.__file__)]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
