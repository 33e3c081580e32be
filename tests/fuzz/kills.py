"""Commands killed, interrupted, or on a full disk: an output is the old file or the new one, whole.

A moment is drawn in one of three ways: by the clock, at an operation on files (so that what stands
between two of them is met, which takes microseconds), or at a byte that is written.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from fuzz.campaign import Command
from fuzz.harness import OLD, OLD_BESIDE, Ended, malformed, put_old, run, seen

OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")
# What a killed run may leave for the next one to go on from, or to sweep up.
BEGUN = re.compile(r"\.resume$|^results(/|\.md$)|(^|/)\.[^/]+\.tmp$")
INTERRUPTED = 128 + signal.SIGINT
KILLED = ("identify", "design", "diagnose", "simulate", "export", "study")
HARMS = ("killed", "disk full", "interrupted")


def at_operation(number: int, act: Callable[[int], object]) -> None:
    """`act` before the `number`-th operation that writes or moves a file; before all for 0."""
    done = [0]

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        reads = event == "open" and not int(arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR)
        if event in OPERATIONS and not reads:
            done[0] += 1
            if number in (0, done[0]):
                act(done[0])

    sys.addaudithook(hook)


def full_disk(byte: int) -> None:
    """No file of this process grows further."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (byte, byte))


class Victim:
    """A command with a campaign of its own, and what it does where nobody harms it."""

    def __init__(self, command: Command, base: Path, folder: Path) -> None:
        self.command, self.base, self.folder = command, base, folder / "a"
        folder.mkdir(parents=True)
        shutil.copytree(base, self.folder)
        self.inputs, begun = seen(base), time.monotonic()
        counter = os.open(folder / "count", os.O_RDWR | os.O_CREAT)
        whole = self.run(lambda: at_operation(0, lambda n: os.pwrite(counter, b"%d" % n, 0)))
        assert whole.code == 0, f"the command itself fails: {whole.told()}"
        self.took, after = time.monotonic() - begun, seen(self.folder)
        self.sizes = {name: len(after[name] or b"") for name in after if name not in self.inputs
                      and not BEGUN.search(name)}  # fmt: skip
        self.operations = int(os.pread(counter, 99, 0))
        os.close(counter)

    def run(self, prepare: Callable[[], object] = lambda: None) -> Ended:
        def in_child() -> None:
            from elastocal.report import figures  # most of what a report costs, and no file

            figures.svg = lambda block: "<svg/>"
            prepare()

        return run([self.command.verb, *self.command.words], self.folder, in_child)

    def harmed(self, harm: str, rng: Random) -> tuple[str, list[str], bool]:
        """One harm at a moment of `rng`: where, what broke, and whether it met the command."""
        shutil.rmtree(self.folder)
        shutil.copytree(self.base, self.folder)
        put_old(self.sizes, self.folder)
        byte = rng.randrange(2000, max([6000, *self.sizes.values()]))  # room for the message
        after, number = rng.uniform(0, self.took), rng.randint(1, self.operations)
        which = signal.SIGINT if harm == "interrupted" else signal.SIGKILL

        def strike(_: int = 0) -> None:
            os.kill(os.getpid(), which)

        def by_clock() -> None:
            timer = threading.Timer(after, strike)
            timer.daemon = True
            timer.start()

        def at_byte() -> None:  # dies of the attempt
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            full_disk(byte)

        moments = {
            f"after {after:.3f} s": by_clock,
            f"at operation {number} of {self.operations}": lambda: at_operation(number, strike),
            f"at byte {byte} of a file": at_byte,
        }
        if harm == "interrupted":
            moments.popitem()
        where = rng.choice([*moments])
        if harm == "disk full":
            where, ended = f"at byte {byte}", self.run(lambda: full_disk(byte))
        else:
            ended = self.run(moments[where])
        found = [*self.wrong(), *(() if harm == "killed" else self.wrongly_ended(ended, harm))]
        if harm == "killed" and rng.random() < 0.1:
            again = self.run()
            found += [f"the next run ends with {again.told()}"] * (again.code != 0)
            found += [f"after the next run: {what}" for what in self.wrong()]
            found += [f"it leaves {name}" for name in seen(self.folder) if name.endswith(".tmp")]
        return f"{harm} {where}", found, harm != "killed" or ended.code < 0

    def wrong(self) -> Iterator[str]:
        there = seen(self.folder)
        for name, content in self.inputs.items():
            if there.get(name) != content:
                yield f"the input {name} has changed or is gone"
        for name, size in self.sizes.items():
            content = there.get(name) or b""
            # Times and versions in it may be shorter, nothing else.
            if content not in (OLD, OLD_BESIDE) and len(content) < 0.98 * size:
                yield f"{name} has {len(content)} bytes of {size}"
            elif content not in (OLD, OLD_BESIDE) and (problem := malformed(name, content)):
                yield f"{name}: {problem}"
        for name in there.keys() - self.inputs.keys() - self.sizes.keys():
            if not BEGUN.search(name):
                yield f"{name} is left"

    def wrongly_ended(self, ended: Ended, harm: str) -> Iterator[str]:
        there, stopped = seen(self.folder), harm == "interrupted"
        new = [name for name in self.sizes if there.get(name) not in (OLD, OLD_BESIDE)]
        whole = len(new) == len(self.sizes)
        if ended.code not in ((0, INTERRUPTED) if stopped else (0, 1, 2)):
            yield f"exit code {ended.code}"
        if ended.code == 0 and not whole:
            yield "exit code 0 without all outputs"
        # Where they appeared just before Ctrl-C, what follows is not told any more.
        if ended.code and new and not (stopped and whole):
            yield f"exit code {ended.code}, and {new} written"
        messages = [line for line in ended.stderr.splitlines() if line.startswith("elastocal: ")]
        once = len(messages) == 1 or (messages and self.command.verb == "study")
        told = once if stopped else messages and "File too large" in ended.stderr
        if (ended.code and not told) or re.search("Traceback|Abort|Exception", ended.stderr):
            yield f"says {ended.stderr[-500:]!r}"
        if any(name.endswith(".tmp") for name in there):
            yield "a temporary file is left"
