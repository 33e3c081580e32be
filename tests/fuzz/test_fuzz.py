"""Spoilt input, kills at any moment and full disks: a few in every run of the tests, many in long.

`python tests/fuzz/run.py --help` has the long runs; what it prints names the case to see again.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from random import Random

import pytest
from fuzz import mutations
from fuzz.campaign import COMMANDS
from fuzz.harness import Case, malformed, pairs, run

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, limits of Linux")

PROGRAM = Path(__file__).with_name("run.py")


def fuzzed(*words: str) -> str:
    """What the fuzzer prints; in a process of its own, since it forks."""
    done = subprocess.run(
        [sys.executable, str(PROGRAM), *words], capture_output=True, text=True, timeout=7200
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_spoilt_input_ends_with_a_message_and_a_kill_leaves_whole_files() -> None:
    verbs = (word for verb in ("identify", "simulate", "study") for word in ("--harmed", verb))
    told = fuzzed("--cases", "24", "--seed", "17", "--kills", "1", *verbs)
    assert "24 cases from 17 on" in told and "3 kills, interrupts and full disks" in told
    assert ": 0 with a finding" in told


@pytest.mark.long
def test_many_spoilt_inputs() -> None:
    fuzzed("--cases", "5000", "--seed", "1000000")


@pytest.mark.long
def test_many_kills_and_full_disks() -> None:
    fuzzed("--cases", "0", "--kills", "60", "--full", "20", "--interrupts", "40")


def test_every_verb_is_among_the_commands() -> None:
    from elastocal.cli.app import VERBS

    assert {command.verb for command in COMMANDS} == set(VERBS)


def test_the_fuzzer_sees_malformed_output() -> None:
    for name, content in (
        ("a.json", b'{"a": NaN}'),
        ("a.json", b'{"a": 1, "a": 2}'),
        ("a.csv", b"a,b\n1\n"),
        ("a.csv", b"a,b\n\x1b,1\n"),
        ("a.urdf", b"<robot>"),
        ("a.toml", b"a = 1\na = 2\n"),
        ("a.html", b"\xff"),
    ):
        assert malformed(name, content)


def test_the_fuzzer_sees_what_breaks(tmp_path, monkeypatch) -> None:
    """A guard of the guard: a verb that breaks every rule has a finding for each."""

    def broken() -> None:
        Path("left.txt").write_text("x")
        Path("there.txt").write_text("x")
        print("\x1b[31m", file=sys.stderr)
        raise RuntimeError("RuntimeWarning")

    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "there.txt").write_text("old")
    monkeypatch.setattr("elastocal.__main__.main", broken)
    case = Case(0, COMMANDS[0], ["x"], "", folder)
    found = " ".join(run(case).complaints)
    assert pairs(case) == set()
    for word in ("traceback", "raw warning", "raw characters", "left.txt", "there.txt", "messages"):
        assert word in found


def test_a_seed_is_a_case() -> None:
    text = "a_mm = 1.5\nb = [1, 2]\n"
    for change in (*mutations.ON_TEXT, mutations.toml_changed):
        assert change(text, Random(3)) == change(text, Random(3))
