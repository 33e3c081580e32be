"""A CasADi function as compiled C: its text, the system's compiler, the library, the call."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import secrets
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.errors import ElastocalError
from elastocal.model.function_cache import (
    HashedFunction,
    casadi_version,
    content_key,
    entry_bytes,
    fetch,
    row_by_row,
    store,
)

# The C text of a function: CasADi's generated code for one row, and a loop over rows.
#
# CasADi writes one function of thousands of statements on one work array.  Compilers need time that
# grows faster than a function's length, so its statements are cut into functions; they
# stay as CasADi wrote them but for the places where inputs are read and outputs stored.

# Statements per C function, and rows that pass through one function before the next: the function
# then stays in the first-level cache, and so does most of the work array.  Measured with gcc 12,
# -O2, B of a KR 270 with 63 parameters (14 000 instructions), as compile time and time per row:
# whole 2.4 s and 2.1 µs; 500 × 1 row 2.0 s and 3.5 µs; 500 × 8 2.1 s and 2.2 µs; 200 × 8 1.7 s and
# 1.9 µs; 100 × 16 1.8 s and 2.1 µs; 200 × 32 1.8 s and 2.4 µs.  With 254 parameters (30 000
# instructions): whole 8.4 s and 4.4 µs, 200 × 8 3.8 s and 5.3 µs.  What is short compiles quickly
# in long functions too, which hand on less through the work array: 3600 statements, 100 000 rows,
# on another processor, beside CasADi's code compiled whole at -O3: 200 × 8 0.7 s and 1.24 times its
# time, 1000 × 4 0.8 s and 1.17, 2000 × 4 0.9 s and 1.10.
PIECE, LONG_PIECE = 200, 2000
SHORT = 5000  # statements of a function that is cut into long pieces
ROWS = 4

_READ = re.compile(r"arg\[(\d+)\]\? arg\[\d+\]\[(\d+)\] : 0")
_STORE = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\d+\]\[(\d+)\]=")
_STATEMENT = re.compile(r"  (?:w\[\d+\]|out\[\d+\]\[\d+\])=[^;]*;")
_BODY = re.compile(r"static int casadi_f0\([^)]*\) \{\n(.*?)  return 0;\n\}\n", re.DOTALL)

_LOOP = """
CASADI_SYMBOL_EXPORT long long elastocal_work(void) {{ return {work}; }}

CASADI_SYMBOL_EXPORT void elastocal_rows(long long first, long long last,
    const double* const* inputs, const long long* strides, double* const* outputs, double* work) {{
  static const long long sizes[] = {{{sizes}}};
  const double* in[{rows}][{n_in}];
  double* out[{rows}][{n_out}];
  for (long long row = first; row < last; row += {rows}) {{
    const int n = last - row < {rows} ? (int) (last - row) : {rows};
    for (int r = 0; r < n; r++) {{
      for (int k = 0; k < {n_in}; k++) in[r][k] = inputs[k] + (row + r) * strides[k];
      for (int k = 0; k < {n_out}; k++) out[r][k] = outputs[k] + (row + r) * sizes[k];
    }}
{calls}
  }}
}}
"""
_CALL = "    for (int r = 0; r < n; r++) piece{k}(in[r], out[r], work + r * {registers});"
_PIECE = """
static __attribute__((noinline)) void piece{k}(const double* const* restrict in,
    double* const* restrict out, double* restrict w) {{
{statements}
}}
"""


class UnknownCode(Exception):
    """CasADi's generated code is not written as it is known here."""


def c_source(function: ca.Function) -> str:
    """C text that exports `elastocal_rows` and `elastocal_work`, the doubles of work it takes.

    `elastocal_rows(first, last, inputs, strides, outputs, work)` evaluates rows first ≤ i < last:
    input k of row i is at inputs[k] + i·strides[k], output k's (rows, columns) at
    outputs[k] + i·rows·columns, row by row.  Structural zeros are not stored.

    Raises UnknownCode where CasADi's code is not what is expected.
    """
    generator = ca.CodeGenerator("tape", {"avoid_stack": True})
    generator.add(function)
    text = generator.dump()
    body = _BODY.search(text)
    if body is None:
        raise UnknownCode("no body")
    places = [row_by_row(function.sparsity_out(k)) for k in range(function.n_out())]
    code = _READ.sub(r"in[\1][\2]", body[1])
    code = _STORE.sub(lambda m: f"out[{m[1]}][{places[int(m[1])][int(m[2])]}]=", code)
    statements = [line for line in code.split("\n") if line.strip()]
    strange = next((line for line in statements if not _STATEMENT.fullmatch(line)), None)
    if strange is not None:
        raise UnknownCode(strange.strip())
    registers = function.sz_w()
    length = LONG_PIECE if len(statements) <= SHORT else PIECE
    pieces = [statements[k : k + length] for k in range(0, len(statements), length)]
    helpers = text[: body.start()].replace("casadi_real casadi_", "static casadi_real casadi_")
    parts = [_PIECE.format(k=k, statements="\n".join(p)) for k, p in enumerate(pieces)]
    calls = "\n".join(_CALL.format(k=k, registers=registers) for k in range(len(pieces)))
    sizes = ", ".join(str(function.numel_out(k)) for k in range(function.n_out()))
    loop = _LOOP.format(
        sizes=sizes or "0",
        rows=ROWS,
        n_in=max(function.n_in(), 1),
        n_out=max(function.n_out(), 1),
        calls=calls,
        work=ROWS * max(registers, 1),
    )
    return "".join([helpers, *parts, loop])


# The system's C compiler: finding it, what it is, and one library from one C text.

# -O2 and no more: with the pieces of `compiled_source`, -march=native gains 8 % and binds a library
# to one processor; -O3 gains nothing.  No contraction to fused operations and no -ffast-math, so
# that results are numpy's but for the last digits of the mathematical functions.
FLAGS = ("-O2", "-shared", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-w")
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
            return _loaded(library, compiler, cached=True)
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
    try:
        source = c_source(function.reduced)
    except UnknownCode as error:
        raise NoCompiler(
            f"CasADi {casadi_version()} writes C that is not known here ({error})"
        ) from None
    key = _key(function, compiler)
    mark = f'\nCASADI_SYMBOL_EXPORT const char elastocal_made_for[] = "{_mark(key)}";\n'
    data = compile_library(compiler, source + mark)
    library = store(key, SUFFIX, data)
    if library is not None:
        return _loaded(library, compiler, cached=False)
    # Without a cache the file is needed only until it is loaded, where the system allows that.
    with tempfile.TemporaryDirectory(prefix="elastocal-", ignore_cleanup_errors=True) as folder:
        library = Path(folder, f"rows-{secrets.token_hex(8)}{SUFFIX}")
        library.write_bytes(data)
        return _loaded(library, compiler, cached=False)


def _loaded(library: Path, compiler: Compiler, cached: bool) -> Compiled:
    try:
        return Compiled(library, compiler, cached)
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
    return content_key("library", function.digest, _written_by(), *flags, *system)


@cache
def _written_by() -> str:
    """Digest of the code that writes the C text."""
    sources = [Path(__file__), Path(__file__).with_name("function_cache.py")]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
