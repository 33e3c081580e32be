"""What reaches a terminal is readable text, whatever names it is made of."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.table import Table
from rich.text import Text

from elastocal.cli.app import Told, reading
from elastocal.messages import printable
from elastocal.screen import complain, safe_console

TITLE, MARK = "\x1b]0;owned\x07", "\u202egpj.exe"
HOSTILE = st.text(
    st.sampled_from(f"ab{TITLE}{MARK}\r\n\t\x9b\u200b\ud800\u2028[red]é°µ "), min_size=1
)


def harmless(text: str) -> bool:
    return all(c.isprintable() or unicodedata.category(c) == "Zs" for c in text.replace("\n", ""))


@given(st.text())
def test_an_escaped_text_is_harmless_and_stays_as_it_is(text):
    once = printable(text)
    assert harmless(once) and "\n" not in once
    assert printable(once) == once
    assert once == text or not text.isprintable()


@settings(deadline=None)
@given(HOSTILE)
def test_no_table_line_or_message_obeys_a_name(name):
    screen = safe_console(file=io.StringIO(), width=200, force_terminal=True, color_system=None)
    table = Table(title=name)
    table.add_column(name)
    table.add_row(Text(name))
    table.add_row(name)
    for thing in (table, Text(name, style="bold"), name):
        screen.print(thing)
    told = screen.file.getvalue().replace("\x1b[1m", "").replace("\x1b[3m", "")
    assert harmless(told.replace("\x1b[0m", "").replace("\x1b[22m", ""))


def test_a_message_is_one_line(capsys):
    complain(f"a\nb{TITLE}\r\n{MARK}")
    assert capsys.readouterr().err == "elastocal: a b\\x1b]0;owned\\x07 \\u202egpj.exe\n"
    complain("\u2028: no such file")
    assert capsys.readouterr().err == "elastocal: \\u2028: no such file\n"


def test_streams_without_the_letters_spell_them_out():
    program = "from elastocal.screen import *\nwith spelling(): say('σ ≤ 3 µm, 20 °, é, \\u202e')"
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment)
    assert done.stdout == b"sigma <= 3 um, 20 deg, \\xe9, \\u202e\n"


def numbers_of_a_library():
    import numpy as np

    np.linalg.cholesky(-np.eye(2))


def memory():
    raise MemoryError


def overflow():
    float(10**400)


def fault():
    raise KeyError("held")


def ended_file():
    raise EOFError("No data left in file")


@pytest.mark.parametrize(
    ("raised", "code", "told"),
    [
        (numbers_of_a_library, 1, "data.csv: .*cannot be computed with .*not positive definite"),
        (overflow, 1, "data.csv: .*too large or too small"),
        (memory, 1, "data.csv: memory ends"),
        (fault, 70, "data.csv: not foreseen: KeyError: 'held' at .*Please report"),
        (ended_file, 70, "data.csv: not foreseen: EOFError: No data left in file"),
    ],
)
def test_what_a_library_raises_is_a_sentence_with_the_files(
    raised, code, told, capsys, monkeypatch
):
    import re

    import typer
    from typer.core import TyperGroup

    monkeypatch.setattr(TyperGroup, "invoke", lambda *_: raised())
    reading[:] = ["data.csv"]
    with pytest.raises(typer.Exit) as ended:
        Told(name="elastocal").invoke(None)
    error = capsys.readouterr().err
    assert ended.value.exit_code == code
    assert re.search(told, error) and error.count("\n") == 1 and "Traceback" not in error


# What stands here is run as a command; it is interrupted in a place that cannot raise.
SWALLOWED = {
    "by a finaliser": """
class Late:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
def run():
    Late()
    time.sleep(60)
""",
    "by nobody, when Python is half taken down": """
class Late:
    def __del__(self, kill=os.kill, number=os.getpid(), interrupt=signal.SIGINT):
        kill(number, interrupt)
late = Late()
def run():
    pass
""",
}


@pytest.mark.parametrize("how", SWALLOWED)
def test_an_interrupt_is_told_in_one_line_wherever_it_falls(how):
    program = f"""
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
{SWALLOWED[how]}
from elastocal.__main__ import main
from elastocal.cli.app import command
command("attacked")(run)
sys.argv = ["elastocal", "attacked"]
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300
    )
    told = (130, "elastocal: interrupted\n") if "by nobody" not in how else (0, "")
    assert (done.returncode, done.stderr) == told
