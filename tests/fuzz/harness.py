"""A command in a process of its own, and what must hold however it ends.

A prepared parent, which has loaded the package and what it needs, forks a child for each command:
it then costs what the command costs, not what loading it costs.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import multiprocessing
import os
import pkgutil
import re
import resource
import shlex
import signal
import sys
import tomllib
import traceback
import unicodedata
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

SECONDS = 30  # of processor time
WALL = 120.0  # s; beyond it a command hangs, also where other programs have the processor
MEMORY = 1_000_000_000  # bytes beside what is loaded
DIRECTIONS = "\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u2028\u2029"
# Folders that a run which fails may leave: tasks that were done, an example half copied.
KEPT = {"study": ("results", "results.md"), "demo": ("demo_out",)}
# What a message may name: an option, a parameter or its place, a key.
NAMED = re.compile(
    r"argument|--?\w|\bjoint\d|\bmarker\b|\[[\w.]+\]|`\w+`|\bkey\b|\bcolumn\b|'[^']+'"
)
# What goes beside an output replaces only what elastocal wrote.
OLD, OLD_BESIDE = b"what was there before\n", b'{"schema": "elastocal/plan/1"}\n'


@dataclass(frozen=True)
class Ended:
    """How a command ended; a negative code is the signal that ended it."""

    words: list[str]
    code: int
    stdout: str
    stderr: str

    def told(self) -> str:
        shown = (self.stderr or self.stdout).strip()
        shown = shown if len(shown) < 3000 else f"{shown[:1000]}\n…\n{shown[-2000:]}"
        return f"    {shlex.join(self.words)[:400]!r}\n    exit {self.code}\n{shown}\n"


def load_everything() -> None:
    """Import the whole package and what it loads on demand, as a child would."""
    import elastocal

    for module in pkgutil.walk_packages(elastocal.__path__, "elastocal."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for name in ("matplotlib.pyplot", "plotly.graph_objects", "pandas",
                 "scipy.optimize", "scipy.stats", "pinocchio", "rich.progress", "rich.table",
                 "mujoco", "pyarrow.parquet"):  # fmt: skip
        with suppress(ImportError):  # an optional one; commands say so themselves
            importlib.import_module(name)


def run(words: list[str], folder: Path, prepare: Callable[[], object] = lambda: None) -> Ended:
    """The command in a child that calls `prepare` first; its outputs go beside `folder`."""
    out, err = folder.with_name("stdout"), folder.with_name("stderr")
    sys.stdout.flush(), sys.stderr.flush()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # until the command begins
    context = multiprocessing.get_context("fork")
    child = context.Process(target=be_child, args=(words, folder, out, err, prepare))
    child.start()
    signal.signal(signal.SIGINT, before)
    child.join(WALL)
    child.kill()
    child.join()
    with suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)  # processes that it started
    told = (path.read_text(encoding="utf-8", errors="surrogateescape") for path in (out, err))
    return Ended(["elastocal", *words], child.exitcode, *told)


def be_child(
    words: list[str], folder: Path, out: Path, err: Path, prepare: Callable[[], object]
) -> None:
    """The command as a shell would start it; never returns."""
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        room = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (room, room))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        prepare()
        sys.argv = ["elastocal", *words]
        from elastocal.__main__ import main

        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(bool(end.code))
        sys.stdout.flush()
    except BaseException:
        code = 1
        traceback.print_exc()
    finally:
        try:
            sys.stderr.flush()
        finally:
            os._exit(code)


def put_old(outputs: Iterable[str], folder: Path) -> None:
    for name in outputs:
        (folder / name).write_bytes(OLD_BESIDE if name.endswith(".json") else OLD)


def seen(folder: Path) -> dict[str, bytes | None]:
    """Every file below `folder` with its content; None for what is no file, or too large."""
    found: dict[str, bytes | None] = {}
    for above, _, names in os.walk(folder):
        for name in names:
            path = Path(above, name)
            small = path.is_file() and path.stat().st_size < 50_000_000
            found[str(path.relative_to(folder))] = path.read_bytes() if small else None
    return found


def complaints(ended: Ended, before: dict[str, bytes | None], folder: Path) -> Iterator[str]:
    """What a command did that none may do, whatever it was given."""
    told, verb = ended.stdout + ended.stderr, ended.words[1]
    if ended.code == -signal.SIGXCPU:
        yield f"more than {SECONDS} s of processor time"
    elif ended.code == -signal.SIGKILL:
        yield f"hangs: more than {WALL:.0f} s"
    elif ended.code not in (0, 1, 2):
        yield f"exit code {ended.code}"
    if found := re.search(r"Traceback|\b[A-Z]\w+Warning\b|Exception ignored", ended.stderr):
        yield f"raw {found[0]}"
    odd = {c for c in told if unicodedata.category(c) in ("Cc", "Cs") or c in DIRECTIONS} - {"\n"}
    if odd:
        yield f"raw characters {sorted(map(ascii, odd))}"
    after = seen(folder)
    new = sorted(name for name in after if name not in before or after[name] != before[name])
    if lost := [name for name in before if name not in after]:
        yield f"removed {lost}"
    if any(name.endswith(".tmp") for name in after):
        yield "a temporary file is left"
    if ended.code == 0:
        for name in new:
            if problem := malformed(name, after[name] or b""):
                yield f"{name}: {problem}"
        if "--json" in ended.words and (problem := malformed("x.json", ended.stdout.encode())):
            yield f"stdout: {problem}"
        return
    kept = KEPT.get(verb, ())
    left = [name for name in new if not kept or not name.startswith(kept)]
    if left and not (kept and "-o" in ended.words):
        yield f"left behind {left}"
    messages = re.findall(r"(?m)^(?:elastocal: |Error: )(.*(?:\n.*)*)", ended.stderr)
    if verb == "study" and not messages and "failed" in ended.stdout:
        return  # the tasks' own errors, listed
    if len(re.findall(r"(?m)^(?:elastocal: |Error: )", ended.stderr)) != 1:
        yield f"{len(messages)} messages"
        return
    files = {Path(word).name or "." for word in (*ended.words, *before)}
    names = files | {name[:60] for name in files}  # as much of it as a message shows
    shown = {name for name in names if name.isprintable()} | {repr(name)[1:-1] for name in names}
    if not (any(name in messages[0] for name in shown) or NAMED.search(messages[0])):
        yield "names no culprit"


def malformed(name: str, content: bytes) -> str | None:
    ending = name.rpartition(".")[2].lower()
    try:
        text = content.decode("utf-8")
        if any(unicodedata.category(c) == "Cc" and c not in "\n\t" for c in text):
            return "control characters"
        if ending == "json":
            json.loads(text, parse_constant=no_json, object_pairs_hook=once)
        elif ending == "csv":
            rows = [row for row in csv.reader(io.StringIO(text)) if row]
            if len({len(row) for row in rows if not row[0].startswith("#")}) > 1:
                return "rows of different lengths"
        elif ending in ("urdf", "xml", "svg"):
            ElementTree.fromstring(text)
        elif ending == "toml":
            tomllib.loads(text)
    except UnicodeDecodeError:
        return None if ending in ("parquet", "png", "npz") else "not UTF-8"
    except (ValueError, ElementTree.ParseError, RecursionError) as error:
        return f"malformed ({error})"
    return None


def no_json(word: str) -> None:
    raise ValueError(f"{word} is no JSON")


def once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key twice")
    return dict(pairs)
