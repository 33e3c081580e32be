"""A CasADi function as compiled C: its text, the system's compiler, the library, the call."""

from __future__ import annotations

import ctypes
import os
import platform
import secrets
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.model import function_cache
from elastocal.model.function_cache import (
    HashedFunction,
    content_key,
    entry_bytes,
    fetch,
    store,
    written_by,
)

# The C text of a function: CasADi's generated code for one row, and a loop over rows.

_LOOP = """
CASADI_SYMBOL_EXPORT long long elastocal_work(void) {{ return {work}; }}

CASADI_SYMBOL_EXPORT void elastocal_rows(long long first, long long last,
    const double* const* inputs, const long long* strides, double* const* outputs, double* work) {{
  static const long long sizes[] = {{{sizes}}};
  const double* in[{n_arg}];
  double* out[{n_res}];
  casadi_int integers[{n_iw}];
  for (long long row = first; row < last; row++) {{
    for (int k = 0; k < {n_in}; k++) in[k] = inputs[k] + row * strides[k];
    for (int k = 0; k < {n_out}; k++) out[k] = outputs[k] + row * sizes[k];
    one_row(in, out, integers, work, 0);
  }}
}}
"""


def c_source(function: ca.Function) -> str:
    """C text that exports `elastocal_rows` and `elastocal_work`, the doubles of work it takes.

    `elastocal_rows(first, last, inputs, strides, outputs, work)` evaluates rows first ≤ i < last:
    input k of row i is at inputs[k] + i·strides[k], output k's (rows, columns) at
    outputs[k] + i·rows·columns, row by row.
    """
    inputs = function.sx_in()
    # CasADi's matrices stand column by column.
    outputs = [ca.densify(output).T for output in function.call(inputs)]
    one_row = ca.Function("one_row", inputs, outputs)
    generator = ca.CodeGenerator("rows", {"avoid_stack": True})
    generator.add(one_row)
    n_in, n_out = one_row.n_in(), one_row.n_out()
    sizes = ", ".join(str(one_row.numel_out(k)) for k in range(n_out))
    loop = _LOOP.format(
        sizes=sizes or "0", n_in=n_in, n_out=n_out, n_arg=max(one_row.sz_arg(), 1),
        n_res=max(one_row.sz_res(), 1), n_iw=max(one_row.sz_iw(), 1), work=max(one_row.sz_w(), 1),
    )  # fmt: skip
    return str(generator.dump()) + loop


# The system's C compiler: finding it, what it is, and one library from one C text.

# One function of thousands of statements: gcc 12 takes 0.5 s for 4000 (B of a KR 270 with 51
# parameters), 1.7 s for 10 000 and 4.5 s for 22 000 at -O1, half as much again at -O2, whose code
# is no faster (10 000 rows 9.6 ms, and 14.6).  Cutting the text into functions of a few hundred
# statements gained 1 to 2 ms of 10 and, beyond 10 000 statements, a quarter of the compiler's time.
# -march=native would bind a library to one processor.  No contraction to fused operations and no
# -ffast-math, so that results are numpy's but for the last digits of the mathematical functions.
FLAGS = ("-O1", "-shared", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-w")
LIBRARIES = ("-lm",)
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
NAMES = ("cc", "gcc", "clang")
TIME_LIMIT = 600.0  # s, of one run of the compiler
HOW_TO_GET_ONE = (
    "install one (Debian or Ubuntu: apt install gcc; macOS: xcode-select --install; conda: "
    "conda install c-compiler) or name it in CC, or use the backend numpy"
)


class NoCompiler(ElastocalError):
    """There is no C compiler, or it does not compile."""


@dataclass(frozen=True)
class Compiler:
    """`command` that runs it, and `version`, the first line that it prints about itself."""

    command: tuple[str, ...]
    version: str

    def __str__(self) -> str:
        return f"{' '.join(self.command)}, {self.version}"


def find_compiler() -> Compiler:
    """$CC where it is set, else the first of cc, gcc, clang on the PATH.

    Raises NoCompiler that says what was looked for.
    """
    asked = os.environ.get("CC", "").strip()
    try:
        words = shlex.split(asked)
    except ValueError:
        words = [asked]
    if words:
        path = shutil.which(words[0])
        if path is None:
            raise NoCompiler(f"CC names '{words[0]}', which is no program here")
        return _described((path, *words[1:]), os.stat(path).st_mtime_ns)
    for name in NAMES:
        if path := shutil.which(name):
            return _described((path,), os.stat(path).st_mtime_ns)
    raise NoCompiler(f"no C compiler on the PATH (looked for {', '.join(NAMES)})")


@lru_cache(maxsize=8)
def _described(command: tuple[str, ...], changed: int) -> Compiler:
    """The compiler `command`; `changed`, when its file was, so that a new one is asked again."""
    try:
        done = subprocess.run(
            [*command, "--version"], capture_output=True, text=True, errors="replace", timeout=30
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NoCompiler(f"{command[0]} --version failed ({error})") from None
    lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    if done.returncode or not lines:
        raise NoCompiler(f"{command[0]} --version failed with exit code {done.returncode}")
    return Compiler(command, lines[0])


def compile_library(compiler: Compiler, source: str) -> bytes:
    """The shared library of a C text.

    Raises NoCompiler with the compiler's first complaint where it fails.
    """
    with tempfile.TemporaryDirectory(prefix="elastocal-") as folder:
        text, library = Path(folder, "rows.c"), Path(folder, f"rows{SUFFIX}")
        command = [*compiler.command, *FLAGS, text.name, "-o", library.name, *LIBRARIES]
        try:
            text.write_text(source)
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, errors="replace",
                timeout=TIME_LIMIT,
            )  # fmt: skip
            if done.returncode == 0:
                return library.read_bytes()
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoCompiler(f"{compiler.command[0]} failed ({error})") from None
    complaint = next(iter(done.stderr.strip().splitlines()), "no message")
    raise NoCompiler(f"{compiler.command[0]} failed with exit code {done.returncode}: {complaint}")


# A function as compiled C: its library found in the cache or compiled, loaded, and called on rows.

COMPILED_CHUNK = 1024  # compiled code has no overhead to spread; small pieces share out evenly
# It takes about 0.15 ns per instruction and row; a thread must have 0.5 ms to do.
WORK_OF_A_THREAD = 3_000_000  # instructions × rows


class Compiled:
    """A library's rows: `evaluate` fills whole blocks of rows without returning to Python.

    It takes float64 arrays only.  The call releases the interpreter's lock.
    """

    name, largest_block = "compiled", COMPILED_CHUNK

    def __init__(self, library: Path, compiler: Compiler, instructions: int, cached: bool) -> None:
        self.compiler, self.cached, self._instructions = compiler, cached, instructions
        loaded = ctypes.CDLL(str(library))
        loaded.elastocal_work.restype = ctypes.c_longlong
        self._work = int(loaded.elastocal_work())
        self._rows = loaded.elastocal_rows
        pointer = ctypes.c_void_p
        self._rows.argtypes = [ctypes.c_longlong, ctypes.c_longlong, *[pointer] * 4]
        self._rows.restype = None

    def threads(self, rows: int) -> int:
        """As many as have enough to do."""
        return 1 + rows * self._instructions // WORK_OF_A_THREAD

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


def find_compiled(function: HashedFunction) -> Compiled | None:
    """The library of `function` where one is cached and loads.

    Raises NoCompiler without a compiler.
    """
    compiler = find_compiler()
    key = _key(function, compiler)
    library = fetch(key, SUFFIX)
    if library is None:
        return None
    try:
        # Before it is loaded, which runs code of it: that of another function is none of this.
        if _mark(key).encode() in entry_bytes(library):
            return _loaded(library, compiler, function.n_instructions, cached=True)
        raise NoCompiler("another function's")
    except (NoCompiler, OSError):  # whole, but not for this system or function
        with suppress(OSError):
            library.unlink()
        return None


def compile_function(function: HashedFunction) -> Compiled:
    """The library of `function`, from the cache or compiled now.

    Raises NoCompiler where there is no compiler or it fails.
    """
    compiler = find_compiler()
    if found := find_compiled(function):
        return found
    source = c_source(function.reduced)
    key = _key(function, compiler)
    mark = f'\nCASADI_SYMBOL_EXPORT const char elastocal_made_for[] = "{_mark(key)}";\n'
    data = compile_library(compiler, source + mark)
    library = store(key, SUFFIX, data)
    if library is not None:
        return _loaded(library, compiler, function.n_instructions, cached=False)
    # Without a cache the file is needed only until it is loaded, where the system allows that.
    with tempfile.TemporaryDirectory(prefix="elastocal-", ignore_cleanup_errors=True) as folder:
        library = Path(folder, f"rows-{secrets.token_hex(8)}{SUFFIX}")
        library.write_bytes(data)
        return _loaded(library, compiler, function.n_instructions, cached=False)


def _loaded(library: Path, compiler: Compiler, instructions: int, cached: bool) -> Compiled:
    try:
        return Compiled(library, compiler, instructions, cached)
    except (OSError, AttributeError) as error:
        raise NoCompiler(f"the library that {compiler} made cannot be loaded ({error})") from None


def _mark(key: str) -> str:
    """What a library holds that was compiled for this key."""
    return f"elastocal library {key}"


def _key(function: HashedFunction, compiler: Compiler) -> str:
    """Everything the library is made from: expressions, C text's author, compiler, flags, system.

    The C text follows from the expressions, CasADi's version and the code here; hashing these
    spares generating it.
    """
    flags = (*compiler.command, compiler.version, *FLAGS, *LIBRARIES)
    system = (sys.platform, platform.machine(), *platform.libc_ver())
    return content_key(
        "library", function.digest, written_by(__file__, function_cache.__file__), *flags, *system
    )
