"""Commands killed, interrupted, or on a full disk: an output is the old file or the new one, whole.

A moment is drawn in one of three ways: by the clock, at an operation on files (so that what stands
between two of them is met, which takes microseconds), or at a byte that is written.
"""

from __future__ import annotations

import os
import re
import resource
import shlex
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from random import Random

from fuzz.campaign import COMMANDS, Command
from fuzz.harness import Case, execute, malformed, old, seen

OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")
# What a killed run may leave for the next one to go on from, or to sweep up.
BEGUN = re.compile(r"\.resume$|^results(/|\.md$)|(^|/)\.[^/]+\.tmp$")
INTERRUPTED = 128 + signal.SIGINT
KILLED = ("identify", "design", "diagnose", "simulate", "export", "study")
HARMS = ("killed", "disk full", "interrupted")


def writes(event: str, arguments: tuple[object, ...]) -> bool:
    """Is this event of `sys.audit` an operation on files that writes or moves?"""
    if event != "open":
        return event in OPERATIONS
    return isinstance(arguments[2], int) and bool(arguments[2] & (os.O_WRONLY | os.O_RDWR))


def signal_at_operation(number: int, which: int, counted: int | None = None) -> None:
    """A signal to this process before the `number`-th operation on files from now on; those that
    were are counted in the file of the descriptor `counted`."""
    done = [0]

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if writes(event, arguments):
            done[0] += 1
            if done[0] == number:
                os.kill(os.getpid(), which)
            if counted is not None:
                os.pwrite(counted, b"%d" % done[0], 0)

    sys.addaudithook(hook)


def draw_nothing() -> None:
    """Pictures are most of what a report costs, and nothing of it is about files."""
    from elastocal.report import figures

    figures.svg = lambda block: "<svg/>"


def full_disk(number: int, kill: bool = False) -> None:
    """No file of this process grows beyond `number` bytes; with `kill` it dies of the attempt."""
    if kill:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))


class Victim:
    """A command with a campaign of its own, and what it does where nobody kills it."""

    def __init__(self, command: Command, base: Path, folder: Path) -> None:
        self.command, self.folder = command, folder / "a"
        shutil.copytree(base, self.folder)
        self.inputs = seen(self.folder)
        counter = os.open(folder / "count", os.O_RDWR | os.O_CREAT)
        whole = self.run(lambda: signal_at_operation(0, 0, counter))
        if whole.code:
            raise RuntimeError(f"the command itself fails: {whole.told()}")
        after = seen(self.folder)
        self.took, self.code = whole.took, 0
        self.sizes = {name: len(after[name] or b"") for name in command.outputs if name in after}
        self.operations = int(os.pread(counter, 99, 0))
        os.close(counter)
        self.restore()

    def run(self, prepare: Callable[[], object] = lambda: None, **when: float) -> Case:
        case = Case(0, self.command, shlex.split(self.command.line), "", self.folder)
        return execute(case, lambda: (draw_nothing(), prepare()), **when)

    def restore(self) -> None:
        """The inputs as they were, and an old file under every output's name."""
        for path in self.folder.iterdir():
            name = path.name
            if name not in self.inputs and not any(i.startswith(f"{name}/") for i in self.inputs):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for name in self.command.outputs:
            (self.folder / name).write_bytes(old(self.command, name))

    def wrong(self) -> Iterator[str]:
        """What stands in the folder now that must not."""
        there = seen(self.folder)
        for name, content in self.inputs.items():
            if name not in self.command.outputs and there.get(name) != content:
                yield f"the input {name} has changed or is gone"
        for name in self.command.outputs:
            content = there.get(name)
            if content is None:
                yield f"{name} is gone"
            elif content != old(self.command, name) and (
                problem := _broken(name, content, self.sizes[name])
            ):
                yield f"{name}: {problem}"
        for name in there.keys() - self.inputs.keys() - set(self.command.outputs):
            if not BEGUN.search(name):
                yield f"{name} is left"

    def harmed(self, harm: str, rng: Random) -> tuple[str, list[str]]:
        """One harm at a moment of `rng`: where it was, and what broke."""
        where, case = self.at_a_moment(harm, rng)
        self.code = case.code
        found = [*self.wrong(), *(() if harm == "killed" else self.wrongly_ended(harm, case))]
        if harm == "killed" and rng.random() < 0.1:
            again = self.run()
            if again.code:
                found.append(f"the next run ends with {again.code}: {again.stderr[-300:]}")
            found += [f"after the next run: {what}" for what in self.wrong()]
            left = [name for name in seen(self.folder) if name.endswith(".tmp")]
            found += [f"the next run leaves {left}"] * bool(left)
        self.restore()
        return where, found

    def at_a_moment(self, harm: str, rng: Random) -> tuple[str, Case]:
        largest, killed = max([6000, *self.sizes.values()]), harm == "killed"
        how = rng.choice(("clock", "operation", "byte") if killed else ("clock", "operation"))
        if harm == "disk full":
            # Room for the message at least, which goes to a file here.
            byte = rng.randrange(2000, largest)
            return f"{harm} at byte {byte}", self.run(lambda: full_disk(byte))
        if how == "byte":
            byte = rng.randrange(largest)
            return f"{harm} at byte {byte} of a file", self.run(lambda: full_disk(byte, kill=True))
        if how == "clock":
            after = rng.uniform(0, self.took)
            ended = self.run(longest=after) if killed else self.run(interrupt=after)
            return f"{harm} after {after:.3f} s", ended
        number, which = rng.randint(1, self.operations), signal.SIGKILL if killed else signal.SIGINT
        ended = self.run(lambda: signal_at_operation(number, which))
        return f"{harm} at operation {number} of {self.operations} on files", ended

    def wrongly_ended(self, harm: str, case: Case) -> Iterator[str]:
        """All outputs, or a message and none of them."""
        there, stopped = seen(self.folder), harm == "interrupted"
        new = [n for n in self.command.outputs if there.get(n) != old(self.command, n)]
        if case.code not in ((0, INTERRUPTED) if stopped else (0, 1, 2)):
            yield f"exit code {case.code}"
        if case.code == 0 and len(new) < len(self.command.outputs):
            yield "exit code 0 without all outputs"
        # Where they appeared just before Ctrl-C, what follows is not told any more.
        if case.code and new and not (stopped and len(new) == len(self.command.outputs)):
            yield f"exit code {case.code}, and {new} written"
        messages = [line for line in case.stderr.splitlines() if line.startswith("elastocal: ")]
        once = len(messages) == 1 or (messages and self.command.verb == "study")
        told = once if stopped else messages and "File too large" in case.stderr
        if (case.code and not told) or re.search("Traceback|Abort|Exception", case.stderr):
            yield f"says {case.stderr[-500:]!r}"
        if any(name.endswith(".tmp") for name in there):
            yield "a temporary file is left"


def _broken(name: str, content: bytes, size: int) -> str | None:
    if not content:
        return "is empty"
    if problem := malformed(name, content):
        return problem
    if len(content) < 0.98 * size:  # times and versions in it may be shorter, nothing else
        return f"has {len(content)} bytes of {size}"
    if name.endswith(".html") and not content.rstrip().endswith(b"</html>"):
        return "ends early"
    return None


def do_harm(
    base: Path, folder: Path, seed: int, times: Mapping[str, int], until: float, verb: str
) -> tuple[list[str], Counter[tuple[str, str]]]:
    """Do to a verb what `times` says so many times: what broke, and how often what was done.

    A few times are of the verb's first command alone, many are of all.  Those are done that begin
    before `until` on the monotonic clock.
    """
    broken, tried = [], Counter[tuple[str, str]]()
    harms = sorted((k / many, harm, k) for harm, many in times.items() for k in range(many))
    commands = [c for c in COMMANDS if c.verb == verb][: 1 + len(harms) // 20]
    victims = [Victim(c, base, folder / f"kill-{verb}{i}") for i, c in enumerate(commands)]
    for i, (_, harm, k) in enumerate(harms):
        rng, victim = Random(f"{seed} {verb} {harm} {k}"), victims[i % len(victims)]
        for _ in range(20):  # one that ends before it is killed does not count
            if time.monotonic() > until:
                return broken, tried
            where, found = victim.harmed(harm, rng)
            if found:
                broken.append(f"--- {victim.command.line}\n    {where}: {'; '.join(found)}\n")
            if harm != "killed" or victim.code < 0:
                tried[verb, harm] += 1
                break
    return broken, tried
