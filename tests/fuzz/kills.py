"""Commands killed, interrupted, or on a full disk: an output is the old file or the new one, whole.

A moment is drawn in one of three ways: by the clock, at an operation on files (so that what stands
between two of them is met, which takes microseconds), or at a byte that is written.
"""

from __future__ import annotations

import json
import math
import os
import re
import resource
import shlex
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import chain, product
from pathlib import Path
from random import Random

from fuzz.campaign import COMMANDS, Command
from fuzz.harness import WALL, Case, apart, be_child, execute, malformed, old, seen, waited

OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")
# What a killed run may leave for the next one to go on from, or to sweep up.
BEGUN = re.compile(r"\.resume$|^results(/|\.md$)|(^|/)\.[^/]+\.tmp$")
INTERRUPTED = 128 + signal.SIGINT
KILLED = ("identify", "design", "diagnose", "simulate", "export", "study")


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


class Standing:
    """A run of a command that stands before its first operation on files.

    What stands there is forked for each kill, so that the computation is done once for all of
    them.  Requests and answers go through pipes, as JSON.
    """

    def __init__(self, case: Case) -> None:
        asked, self._ask = os.pipe()
        self._answered, answers = os.pipe()
        self._out, self._err = (case.folder.parent / name for name in ("stdout2", "stderr2"))
        sys.stdout.flush(), sys.stderr.flush()
        self._child = os.fork()
        if self._child == 0:
            os.close(self._ask)
            be_child(case, self._out, self._err, lambda: self._stand(asked, answers))
        os.close(asked), os.close(answers)

    def _stand(self, asked: int, answers: int) -> None:
        draw_nothing()
        stood: list[bool] = []

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            if not stood and writes(event, arguments):
                stood.append(True)
                self._serve(asked, answers)

        sys.addaudithook(hook)

    def _serve(self, asked: int, answers: int) -> None:
        """Fork for every request; returns in the forks alone."""
        while request := os.read(asked, 4096):
            how, number, which = json.loads(request)
            child = os.fork()
            if child == 0:
                apart(self._out, self._err)
                if how == "byte":
                    full_disk(number, bool(which))
                elif number == 1:
                    os.kill(os.getpid(), which)
                else:
                    signal_at_operation(number - 1, which)
                return
            status, _ = waited(child, time.monotonic() + WALL)
            os.write(answers, json.dumps(status).encode())
        os._exit(0)

    def go_on(self, case: Case, how: str, number: int, which: int) -> Case:
        """A fork of the run with a signal `which` before an operation on files, or, with `how`
        "byte", a disk that is full at it; it dies of that where `which` is not 0."""
        os.write(self._ask, json.dumps([how, number, which]).encode())
        case.code = os.waitstatus_to_exitcode(json.loads(os.read(self._answered, 4096)))
        case.stderr = self._err.read_text(encoding="utf-8", errors="surrogateescape")
        return case

    def close(self) -> None:
        os.close(self._ask), os.close(self._answered)
        os.kill(self._child, signal.SIGKILL)
        os.waitpid(self._child, 0)


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

    @cached_property
    def standing(self) -> Standing:
        return Standing(self.case())

    def case(self) -> Case:
        return Case(0, self.command, shlex.split(self.command.line), "", self.folder)

    def run(self, prepare: Callable[[], object] = lambda: None, **when: float) -> Case:
        return execute(self.case(), lambda: (draw_nothing(), prepare()), **when)

    def go_on(self, how: str, number: int, which: int) -> Case:
        return self.standing.go_on(self.case(), how, number, which)

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

    def killed(self, rng: Random) -> tuple[str, list[str]]:
        """One kill at a moment of `rng`: where it was, and what broke."""
        how = rng.randrange(3)
        if how == 0:
            where = f"after {(longest := rng.uniform(0, self.took)):.3f} s"
            case = self.run(longest=longest)
        elif how == 1:
            number = rng.randint(1, self.operations)
            where = f"at operation {number} of {self.operations} on files"
            case = self.go_on("operation", number, signal.SIGKILL)
        else:
            number = rng.randrange(max(self.sizes.values(), default=3000))
            where = f"at byte {number} of a file"
            case = self.go_on("byte", number, signal.SIGXFSZ)
        self.code = case.code
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
            case = self.go_on("operation", number, signal.SIGINT)
        found, there = list(self.wrong()), seen(self.folder)
        new = [n for n in self.command.outputs if there.get(n) != old(self.command, n)]
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
        case = self.go_on("byte", number, 0)
        found = list(self.wrong())
        there = seen(self.folder)
        new = [n for n in self.command.outputs if there.get(n) != old(self.command, n)]
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
    base: Path, folder: Path, seed: int, times: dict[str, int], verbs: Sequence[str] = KILLED,
    part: slice = slice(None), until: float = math.inf,
) -> tuple[int, Counter]:  # fmt: skip
    """Do to each of the `verbs` what `times` says so many times, as HARMS has it.

    Findings are printed.  A few times are of the verb's first command alone, many are of all.
    `part` of them is run, those that begin before `until` on the monotonic clock.
    """
    broken, tried = 0, Counter[tuple[str, str]]()
    harms = [(k / number, harm, k) for harm, number in times.items() for k in range(number)]
    victims = {
        verb: [
            Victim(c, base, folder / f"kill-{verb}{i}")
            for i, c in enumerate([c for c in COMMANDS if c.verb == verb][: 1 + len(harms) // 20])
        ]
        for verb in verbs
    }
    for (i, (_, harm, k)), verb in product(list(enumerate(sorted(harms)))[part], verbs):
        if time.monotonic() > until:
            break
        rng, victim = Random(f"{seed} {verb} {harm} {k}"), victims[verb][i % len(victims[verb])]
        for _ in range(20):  # one that ends before it is killed does not count
            where, found = HARMS[harm](victim, rng)
            if found:
                broken += 1
                told = f"--- {victim.command.line}\n    {where}: {'; '.join(found)}\n"
                print(told, flush=True)
            if harm != "killed" or victim.code < 0:
                tried[verb, harm] += 1
                break
    for victim in chain(*victims.values()):
        if "standing" in vars(victim):
            victim.standing.close()
    return broken, tried


HARMS = {"killed": Victim.killed, "disk full": Victim.refused, "interrupted": Victim.interrupted}
