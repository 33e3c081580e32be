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
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from fuzz.campaign import COMMANDS, Command
from fuzz.harness import OLD, Case, execute, malformed, seen

OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")
# What a killed run may leave for the next one to go on from, or to sweep up.
BEGUN = re.compile(r"\.resume/|^results(/|\.md$)|(^|/)\.[^/]+\.tmp$")
INTERRUPTED = 128 + signal.SIGINT
KILLED = ("identify", "design", "diagnose", "simulate", "export", "study")


def kill_at_operation(
    number: int, counted: Path | None = None, by: signal.Signals = signal.SIGKILL
) -> None:
    """A signal before the `number`-th operation on files of this process that writes or moves."""
    left = [number]

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event not in OPERATIONS:
            return
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & os.O_WRONLY):
            return
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), by)
        if counted is not None:
            counted.write_text(str(number - left[0])) if event != "open" else None

    sys.addaudithook(hook)


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
        counter = folder / "count"
        whole = self.run(lambda: kill_at_operation(10**9, counter))
        if whole.code:
            raise RuntimeError(f"the command itself fails: {whole.told()}")
        after = seen(self.folder)
        self.took = whole.took
        self.sizes = {name: len(after[name] or b"") for name in command.outputs if name in after}
        self.operations = int(counter.read_text())
        self.restore()

    def run(self, prepare: Callable[[], object] = lambda: None, **when: float) -> Case:
        case = Case(0, self.command, shlex.split(self.command.line), "", self.folder)
        return execute(case, prepare, **when)

    def restore(self) -> None:
        """The inputs as they were, and an old file under every output's name."""
        for path in self.folder.iterdir():
            name = path.name
            if name not in self.inputs and not any(i.startswith(f"{name}/") for i in self.inputs):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for name in self.command.outputs:
            (self.folder / name).write_bytes(OLD)

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
            elif content != OLD and (problem := _broken(name, content, self.sizes[name])):
                yield f"{name}: {problem}"
        for name in there.keys() - self.inputs.keys() - set(self.command.outputs):
            if not BEGUN.search(name):
                yield f"{name} is left"

    def killed(self, rng: Random) -> tuple[str, list[str]]:
        """One kill at a moment of `rng`: where it was, and what broke."""
        how = rng.randrange(3)
        if how == 0:
            where = f"after {(longest := rng.uniform(0, self.took)):.3f} s"
            self.run(longest=longest)
        elif how == 1:
            number = rng.randint(1, self.operations)
            where = f"at operation {number} of {self.operations} on files"
            self.run(lambda: kill_at_operation(number))
        else:
            number = rng.randrange(max(self.sizes.values(), default=3000))
            where = f"at byte {number} of a file"
            self.run(lambda: full_disk(number, kill=True))
        found = list(self.wrong())
        if rng.random() < 0.1:
            again = self.run()
            if again.code:
                found.append(f"the next run ends with {again.code}: {again.stderr[-300:]}")
            found += [f"after the next run: {what}" for what in self.wrong()]
            left = [name for name in seen(self.folder) if name.endswith(".tmp")]
            found += [f"the next run leaves {left}"] * bool(left)
        self.restore()
        return where, found

    def interrupted(self, rng: Random) -> tuple[str, list[str]]:
        """One Ctrl-C at a moment of `rng`: all outputs, or one line and no new output."""
        if rng.random() < 0.5:
            where = f"Ctrl-C after {(moment := rng.uniform(0, self.took)):.3f} s"
            case = self.run(interrupt=moment)
        else:
            number = rng.randint(1, self.operations)
            where = f"Ctrl-C at operation {number} of {self.operations} on files"
            case = self.run(lambda: kill_at_operation(number, by=signal.SIGINT))
        found, there = list(self.wrong()), seen(self.folder)
        new = [n for n in self.command.outputs if there.get(n) != OLD]
        messages = [line for line in case.stderr.splitlines() if line.startswith("elastocal: ")]
        study = self.command.verb == "study"
        if case.code not in (0, INTERRUPTED):
            found.append(f"exit code {case.code}")
        if case.code == 0 and len(new) < len(self.command.outputs):
            found.append("exit code 0 without all outputs")
        # Where they appeared just before it, what follows is not told any more.
        if case.code == INTERRUPTED and new and len(new) < len(self.command.outputs):
            found.append(f"of its outputs {new} alone")
        if case.code == INTERRUPTED and ((len(messages) != 1 and not study) or not messages):
            found.append(f"says {case.stderr[-300:]!r}")
        if "Traceback" in case.stderr or "Abort" in case.stderr or "Exception" in case.stderr:
            found.append(f"says {case.stderr[-500:]!r}")
        if [name for name in there if name.endswith(".tmp")]:
            found.append("a temporary file is left")
        self.restore()
        return where, found

    def refused(self, rng: Random) -> tuple[str, list[str]]:
        """One run on a disk that is full at a byte of `rng`: a message, and nothing has changed."""
        # Room for the message at least, which goes to a file here.
        number = rng.randrange(2000, max([6000, *self.sizes.values()]))
        case = self.run(lambda: full_disk(number))
        found = list(self.wrong())
        there = seen(self.folder)
        new = [n for n in self.command.outputs if there.get(n) != OLD]
        if case.code == 0 and len(new) < len(self.command.outputs):
            found.append("exit code 0 without all outputs")
        if case.code != 0 and new:
            found.append(f"exit code {case.code}, and {new} written")
        if case.code not in (0, 1, 2):
            found.append(f"exit code {case.code}")
        if case.code and not ("elastocal: " in case.stderr and "File too large" in case.stderr):
            found.append(f"says {case.stderr[-300:]!r}")
        if "Traceback" in case.stderr or "Exception" in case.stderr:
            found.append(f"says {case.stderr[-500:]!r}")
        if [name for name in there if name.endswith(".tmp")]:
            found.append("a temporary file is left")
        self.restore()
        return f"disk full at byte {number}", found


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


def run_kills(
    base: Path, folder: Path, seed: int, times: dict[str, int], part: slice = slice(None)
) -> tuple[int, Counter]:
    """Do to each verb what `times` says so many times, as HARMS has it; findings are printed.

    A few times are of the verb's first command alone, many are of all.  `part` of them is run.
    """
    broken, tried = 0, Counter[tuple[str, str]]()
    harms = [(harm, k) for harm, number in times.items() for k in range(number)]
    for verb in KILLED:
        commands = [c for c in COMMANDS if c.verb == verb][: 1 + len(harms) // 20]
        victims = [Victim(c, base, folder / f"kill-{verb}{i}") for i, c in enumerate(commands)]
        for i, (harm, k) in list(enumerate(harms))[part]:
            rng, victim = Random(f"{seed} {verb} {harm} {k}"), victims[i % len(victims)]
            where, found = HARMS[harm](victim, rng)
            tried[verb, harm] += 1
            if found:
                broken += 1
                print(f"--- {victim.command.line}\n    {where}: {'; '.join(found)}\n", flush=True)
    return broken, tried


HARMS = {"killed": Victim.killed, "disk full": Victim.refused, "interrupted": Victim.interrupted}
