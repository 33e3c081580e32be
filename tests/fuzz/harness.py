"""One spoilt case in a process of its own, and what must hold however it ends.

A prepared parent, which has loaded the package and what it needs, forks a child for each case: a
case then costs what the command costs, not what loading it costs.  A case follows from its seed.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import os
import pkgutil
import re
import resource
import shlex
import shutil
import signal
import sys
import time
import traceback
import unicodedata
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from random import Random

from fuzz.campaign import COMMANDS, Command
from fuzz.grammar import grown
from fuzz.mutations import spoil, spoil_arguments

SECONDS = 30  # of processor time
WALL = 120.0  # s; beyond it a case hangs, also where other programs have the processor
GROWN = 0.4  # share of cases that are made by the grammar, not spoilt
MEMORY = 1_000_000_000  # bytes resident, what is loaded included
OLD = b"what was there before\n"
# What goes beside an output replaces only what elastocal wrote.
OLD_BESIDE = b'{"schema": "elastocal/plan/1"}\n'
DIRECTIONS = "\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u2028\u2029"
# Folders that a run which fails may leave: tasks that were done, an example half copied.
KEPT = {"study": ("results", "results.md"), "demo": ("demo_out",)}
# What a message may name: an option, a parameter or its place, a key.
NAMED = re.compile(
    r"argument|--?\w|\bjoint\d|\bmarker\b|\[[\w.]+\]|`\w+`|\bkey\b|\bcolumn\b|'[^']+'"
)


@dataclass
class Case:
    """What was run and how it ended."""

    seed: int
    command: Command
    words: list[str]
    done: str
    folder: Path
    code: int = 0
    stdout: str = ""
    stderr: str = ""
    seconds: float = 0.0  # of processor time
    took: float = 0.0  # s by the clock
    resident: int = 0
    complaints: list[str] = field(default_factory=list)
    then: list[tuple[Command, list[str]]] = field(default_factory=list)  # verbs that follow

    @property
    def line(self) -> str:
        return shlex.join(["elastocal", self.command.verb, *self.words])

    def told(self) -> str:
        """A finding as it is reported: what broke, and how to see it again."""
        message = (self.stderr or self.stdout).strip()
        short = message if len(message) < 3000 else f"{message[:1000]}\n…\n{message[-2000:]}"
        return (
            f"--- case {self.seed}: {'; '.join(self.complaints)}\n"
            f"    {self.line[:400]!r}\n    {self.done[:400]}\n"
            f"    exit {self.code}, {self.seconds:.1f} s, {self.resident / 1e6:.0f} MB\n"
            f"    again: python tests/fuzz/run.py --case {self.seed}\n{short}\n"
        )


def load_everything() -> None:
    """Import the whole package and what it loads on demand, as a child would."""
    import elastocal

    for module in pkgutil.walk_packages(elastocal.__path__, "elastocal."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for name in ("cvxpy", "clarabel", "matplotlib.pyplot", "plotly.graph_objects", "pandas",
                 "scipy.optimize", "scipy.stats", "pinocchio", "pyvrp", "rich.progress",
                 "rich.table", "mujoco", "pyarrow.parquet"):  # fmt: skip
        with suppress(ImportError):  # an optional one; commands say so themselves
            importlib.import_module(name)


def make(seed: int, base: Path, folder: Path, verbs: tuple[str, ...] = ()) -> Case:
    """The spoilt case of a seed in `folder`, which must not exist; `base` is the campaign."""
    rng = Random(seed)
    if not verbs and rng.random() < GROWN:
        work = folder / "a" / "b" / "c"
        (command, words), *then = grown(work, rng)
        return Case(seed, command, words, f"grown: {chained(then)}", work, then=then)
    command = rng.choice([c for c in COMMANDS if not verbs or c.verb in verbs])
    # What `..` names stays within the case.
    work = folder / "a" / "b" / "c"
    shutil.copytree(base, work)
    words = shlex.split(command.line)
    files = [work / name for name in (*words, *command.named) if (work / name).is_file()]
    done = []
    if files and rng.random() < 0.75:
        done.append(spoil(rng.choice(files), rng))
    if not done or rng.random() < 0.05:
        words, how = spoil_arguments(words, rng)
        done.append(how)
    if rng.random() < 0.5:
        for name in command.outputs:
            (work / name).write_bytes(old(command, name))
    return Case(seed, command, words, "; ".join(done), work)


def run(case: Case) -> Case:
    """Run the case in a child; what broke is in its `complaints`."""
    before = seen(case.folder)
    execute(case)
    case.complaints = list(_complaints(case, before))
    if case.then and case.code == 0 and not case.complaints:
        (command, words), *then = case.then
        return run(Case(case.seed, command, words, case.done, case.folder, then=then))
    return case


def chained(verbs: list[tuple[Command, list[str]]]) -> str:
    return " > ".join(command.verb for command, _ in verbs)


def execute(
    case: Case,
    prepare: Callable[[], object] = lambda: None,
    longest: float = WALL,
    interrupt: float | None = None,
) -> Case:
    """Run the case in a child, which calls `prepare` first and is killed after `longest` s.

    After `interrupt` s somebody presses Ctrl-C.
    """
    out, err = case.folder.parent / "stdout", case.folder.parent / "stderr"
    begun = time.monotonic()
    sys.stdout.flush(), sys.stderr.flush()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # until the command begins
    child = os.fork()
    if child == 0:
        be_child(case, out, err, prepare)
    signal.signal(signal.SIGINT, before)
    pressed = None if interrupt is None else begun + interrupt
    status, usage = waited(child, begun + longest, pressed)
    case.took = time.monotonic() - begun
    case.seconds = usage.ru_utime + usage.ru_stime
    case.resident = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    case.code = os.waitstatus_to_exitcode(status)
    case.stdout = out.read_text(encoding="utf-8", errors="surrogateescape")
    case.stderr = err.read_text(encoding="utf-8", errors="surrogateescape")
    return case


def be_child(case: Case, out: Path, err: Path, prepare: Callable[[], object]) -> None:
    """In the child: the command as a shell would start it; never returns."""
    code = 1
    try:
        os.chdir(case.folder)
        apart(out, err)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        room = pages * os.sysconf("SC_PAGE_SIZE") + 2 * MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (room, room))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        prepare()
        sys.argv = ["elastocal", case.command.verb, *case.words]
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


def apart(out: Path, err: Path) -> None:
    """In a child: a group of processes of its own, and what it tells in files of its own."""
    os.setsid()
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)


def waited(
    child: int, deadline: float, interrupt: float | None = None
) -> tuple[int, resource.struct_rusage]:
    pause = 0.002
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if interrupt is not None and time.monotonic() > interrupt:
            os.kill(child, signal.SIGINT)
            interrupt = None
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            break
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)  # processes that it started
    return status, usage


def old(command: Command, name: str) -> bytes:
    """What stands under the name of an output before the command runs."""
    beside = name.endswith(".json") and f"{name[:-5]}.csv" in command.outputs
    return OLD_BESIDE if beside else OLD


def seen(folder: Path) -> dict[str, bytes | None]:
    """Every file below `folder` with its content; None for what is no file, or too large."""
    found: dict[str, bytes | None] = {}
    for above, _, names in os.walk(folder):
        for name in names:
            path = Path(above, name)
            small = path.is_file() and path.stat().st_size < 50_000_000
            found[str(path.relative_to(folder))] = path.read_bytes() if small else None
    return found


def _complaints(case: Case, before: dict[str, bytes | None]) -> Iterator[str]:
    told = case.stdout + case.stderr
    if case.code == -signal.SIGXCPU or case.seconds > SECONDS:
        yield f"more than {SECONDS} s of processor time"
    elif case.code == -signal.SIGKILL:
        yield f"hangs: more than {WALL:.0f} s"
    elif case.code not in (0, 1, 2):
        yield f"exit code {case.code}"
    if case.resident > MEMORY:
        yield "more than 1 GB"
    if "Traceback" in told:
        yield "traceback"
    if found := re.search(r"\b[A-Z]\w+Warning\b|Exception ignored", case.stderr):
        yield f"raw warning {found[0]}"
    odd = {c for c in told if unicodedata.category(c) in ("Cc", "Cs") or c in DIRECTIONS} - {"\n"}
    if odd:
        yield f"raw characters {sorted(map(ascii, odd))}"
    after = seen(case.folder)
    new = {name for name in after if name not in before or after[name] != before[name]}
    if case.code != 0:
        kept = KEPT.get(case.command.verb, ())
        left = [name for name in sorted(new) if not name.startswith(kept)] if kept else sorted(new)
        if left and not (case.command.verb in KEPT and "-o" in case.line):
            yield f"left behind {left}"
        yield from _message_complaints(case)
    lost = [name for name in before if name not in after]
    if lost:
        yield f"removed {lost}"
    if any(name.endswith(".tmp") for name in after):
        yield "a temporary file is left"
    if case.code == 0:
        # With -o and --report exchanged a name does not say what is in the file.
        meant = {b for a, b in pairwise(shlex.split(case.command.line)) if (a, b) in pairs(case)}
        for name in sorted(new):
            content = after[name]
            if content is not None and name in meant and (problem := malformed(name, content)):
                yield f"{name}: {problem}"
        if _as_json(case) and (problem := malformed("x.json", case.stdout.encode())):
            yield f"stdout: {problem}"


def _message_complaints(case: Case) -> Iterator[str]:
    messages = re.findall(r"(?m)^(?:elastocal: |Error: )", case.stderr)
    if case.command.verb == "study" and not messages and "failed" in case.stdout:
        return  # the tasks' own errors, listed
    if len(messages) != 1:
        yield f"{len(messages)} messages"
        return
    message = case.stderr[case.stderr.index(messages[0]) + len(messages[0]) :]
    words = (*case.words, *case.command.line.split(), *case.command.named)
    names = {Path(word).name or "." for word in words}
    names |= {name[:60] for name in names}  # as much of it as a message shows
    shown = {name for name in names if name.isprintable()} | {repr(name)[1:-1] for name in names}
    if not (any(name in message for name in shown) or NAMED.search(message)):
        yield "names no culprit"


def pairs(case: Case) -> set[tuple[str, str]]:
    return set(pairwise(case.words))


def _as_json(case: Case) -> bool:
    """Is --json an option there, not the value of another one?"""
    before = [above for above, word in pairs(case) if word == "--json"]
    return any(not above.startswith("-") or above == "-q" for above in before)


def malformed(name: str, content: bytes) -> str | None:
    """What is wrong with a written file of this name, or None."""
    ending = name.rpartition(".")[2].lower()
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return None if ending in ("parquet", "png", "npz") else "not UTF-8"
    if ending in ("json", "csv", "toml", "html", "src", "script", "urdf", "xml") and any(
        unicodedata.category(c) == "Cc" and c not in "\n\t" for c in text
    ):
        return "control characters"
    try:
        if ending == "json":
            json.loads(text, parse_constant=_no_json, object_pairs_hook=_once)
        elif ending == "csv":
            rows = [row for row in csv.reader(io.StringIO(text)) if row]
            if len({len(row) for row in rows if not row[0].startswith("#")}) > 1:
                return "rows of different lengths"
        elif ending in ("urdf", "xml", "svg"):
            ElementTree.fromstring(text)
        elif ending == "toml":
            importlib.import_module("tomllib").loads(text)
    except (ValueError, ElementTree.ParseError, RecursionError) as error:
        return f"malformed ({error})"
    return None


def _no_json(word: str) -> None:
    raise ValueError(f"{word} is no JSON")


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key twice")
    return dict(pairs)
