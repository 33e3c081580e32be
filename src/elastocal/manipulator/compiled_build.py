"""The system's C compiler: finding it, what it is, and one library from one C text."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from elastocal.errors import ElastocalError

# -O2 and no more: with the pieces of `compiled_source`, -march=native gains 8 % and binds a library
# to one processor; -O3 gains nothing.  No contraction to fused operations and no -ffast-math, so
# that results are the replay's but for the last digits of the mathematical functions.
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
        text, library = Path(folder, "tape.c"), Path(folder, f"tape{SUFFIX}")
        text.write_text(source)
        command = [*compiler.command, *FLAGS, text.name, "-o", library.name, *LIBRARIES]
        try:
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
