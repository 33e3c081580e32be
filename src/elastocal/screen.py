"""The terminal: the one place that everything shown to a person passes.

Names come from files and arguments, and a terminal obeys what stands in them: escape sequences
that change its title or colours, marks that turn the direction of writing round.  What is shown
here is shown as it can be read (`elastocal.messages.printable`), in letters that the terminal has.
"""

from __future__ import annotations

import atexit
import codecs
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

from elastocal.messages import printable

if TYPE_CHECKING:
    from rich.console import Console

# What stands for letters that a stream cannot write, in ASCII and latin-1.
SPELT = {
    "µ": "u", "°": "deg", "²": "^2", "³": "^3", "·": "*", "×": "x", "±": "+/-", "−": "-", "–": "-",
    "—": "-", "…": "...", "≤": "<=", "≥": ">=", "∞": "inf", "’": "'", "‘": "'", "“": '"',
    "”": '"', "→": "->", "σ": "sigma", "ρ": "rho", "χ": "chi", "Δ": "Delta", "₀": "0",
    "α": "alpha", "β": "beta", "δ": "delta", "ε": "eps", "θ": "theta", "ν": "nu", "τ": "tau",
    "φ": "phi", "Σ": "sum", "∂": "d", "√": "sqrt", "≠": "!=", "½": "1/2",
    "\u00a0": " ", "\u202f": " ", "\u2009": " ",
}  # fmt: skip


def _spelt(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    part = error.object[error.start : error.end]
    return "".join(SPELT.get(c) or ascii(c)[1:-1] for c in part), error.end


codecs.register_error("elastocal", _spelt)


@contextmanager
def spelling() -> Iterator[None]:
    """Within it stdout and stderr spell out what their encoding lacks, instead of failing; then
    what is left is written, and a reader that went away (… | head) is no error."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="elastocal")
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                if stream is not None:
                    stream.flush()
            except (OSError, ValueError):
                # Python flushes once more at its end, and would complain.
                with suppress(OSError, ValueError):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


# Ctrl-C: noted besides being raised, since libraries swallow it or make another error of it.

interrupts: list[int] = []


@contextmanager
def noting_interrupts() -> Iterator[list[int]]:
    """A SIGINT that would raise KeyboardInterrupt is noted too; where code that cannot raise
    (Cython's, a finaliser's) swallows one, it comes again."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not ignored, as under nohup
        signal.signal(signal.SIGINT, _note)
        # Python takes its handlers down when it ends, but what is ignored stays so.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    hooks = sys.excepthook, sys.unraisablehook
    sys.excepthook = lambda kind, *what: kind is KeyboardInterrupt or hooks[0](kind, *what)

    def swallowed(what: Any) -> None:
        if what.exc_type is not KeyboardInterrupt:
            hooks[1](what)
        elif interrupts:
            threading.Timer(0.05, _press_again).start()

    sys.unraisablehook = swallowed
    try:
        yield interrupts
    finally:
        sys.excepthook, sys.unraisablehook = hooks


def _press_again() -> None:
    if signal.getsignal(signal.SIGINT) is _note:  # not all is written
        os.kill(os.getpid(), signal.SIGINT)


def _note(number: int, frame: FrameType | None) -> None:
    interrupts.append(number)
    signal.default_int_handler(number, frame)


GRACE = 30.0  # s that running tasks of a study are waited for


class StudyStop:
    """Ctrl-C and SIGTERM: within it `asked` says that no more tasks may be handed out.  A second
    signal, or `grace` seconds after the first, raises KeyboardInterrupt, and `check` raises it
    again: a task's library may catch one and return where its search stood, and such a result must
    not be kept."""

    def __init__(self, grace: float = GRACE, tell: Callable[[str], None] | None = None) -> None:
        self.asked = self._now = False
        # In a signal handler the buffer of sys.stderr may be in use by what was interrupted.
        self._tell = tell or (lambda text: os.write(2, f"\nelastocal: {text}\n".encode()) and None)
        self._grace = grace
        self._before: dict[int, Any] = {}

    def check(self) -> None:
        if self._now:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # only it may set handlers
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        while self._before:
            signal.signal(*self._before.popitem())

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            self._now = True
            raise KeyboardInterrupt
        self.asked = True
        self._tell(
            f"stopping: the running tasks have {self._grace:.0f} s to end (Ctrl-C again: at once)"
        )
        signal.setitimer(signal.ITIMER_REAL, self._grace)


def end_at_once() -> None:
    """All is written: from here on Ctrl-C ends the process with its one line and no traceback."""

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, b"elastocal: interrupted\n")
        os._exit(128 + number)

    if signal.getsignal(signal.SIGINT) is _note:
        signal.signal(signal.SIGINT, end)


def shown(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))


def say(text: str, error: bool = False, end: str = "\n") -> None:
    stream = sys.stderr if error else sys.stdout
    if stream is None:
        return
    try:
        stream.write(shown(text) + end)
        stream.flush()
    except OSError:
        if not error:  # where stderr is full there is nobody to tell
            raise


def complain(message: str) -> None:
    # splitlines() would swallow \u2028 and the like, which a name may be made of.
    lines = map(printable, message.replace("\r\n", "\n").split("\n"))
    say(f"elastocal: {' '.join(lines)}", error=True)


def safe_console(**how: Any) -> Console:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class SafeConsole(Console):
        def on_broken_pipe(self) -> None:
            self.quiet = True  # a reader that went away (… | head) is no error: rich would exit

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterable[Segment]:
            """As inherited; `control` segments are rich's own."""
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else shown(text), style, control)

    return SafeConsole(highlight=False, markup=False, emoji=False, **how)


SHARE = re.compile(r"\b(\d+) of (\d+)\b")


@contextmanager
def progress_line(quiet: bool, every: float = 0.0) -> Iterator[Callable[[str], None]]:
    """A status line on stderr with the time since the start and, where a message counts ("3 of
    12"), the share done; nothing where `quiet`.  Without a terminal a line for each message, of
    those that come faster than `every` s the first and the last ("12 of 12")."""
    if quiet:
        yield lambda message: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = safe_console(stderr=True)
    if not screen.is_terminal:
        begun, told = monotonic(), -every

        def line(message: str) -> None:
            nonlocal told
            now, found = monotonic() - begun, SHARE.search(message)
            if now - told >= every or (found and found[1] == found[2]):
                told = now
                screen.print(f"… {message} ({now:.0f} s)")

        yield line
        return

    text = TextColumn("{task.description}", markup=False)
    # A bar that only moves while nothing is known of the share.
    columns = (TimeElapsedColumn(), text, BarColumn(bar_width=20))
    with Progress(*columns, console=screen, transient=True) as shown_line:
        task = shown_line.add_task("starting", total=None)

        def tell(message: str) -> None:
            found = SHARE.search(message)
            total, done = (int(found[2]), int(found[1])) if found else (None, 0)
            shown_line.update(task, description=message)
            shown_line.tasks[0].total, shown_line.tasks[0].completed = total, done

        yield tell
