"""Spoilt input, kills at any moment and full disks: a few in every run of the tests, many in long.

`python tests/fuzz/run.py --help` has the long runs; what it prints names the case to see again.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.campaign import COMMANDS, VERBS
from fuzz.harness import complaints, malformed, run, seen

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
    quick = (w for verb in ("identify", "study") for w in ("--verb", verb))
    told = fuzzed("--cases", "8", "--seed", "17", "--kills", "1", *quick)
    assert "killed 2; 0 with a finding" in told and "exit 2" in told


@pytest.mark.long
def test_many_spoilt_inputs() -> None:
    fuzzed("--cases", "5000", "--seed", "1000000")


@pytest.mark.long
def test_many_kills_and_full_disks() -> None:
    fuzzed("--cases", "0", "--kills", "60", "--full", "20", "--interrupts", "40")


def test_every_verb_is_among_the_commands() -> None:
    assert {command.verb for command in COMMANDS} == set(VERBS)


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
    before = seen(folder)
    monkeypatch.setattr("elastocal.__main__.main", broken)
    found = " ".join(complaints(run(["identify"], folder), before, folder))
    for word in ("raw Traceback", "raw characters", "left.txt", "there.txt", "0 messages"):
        assert word in found
    for name, content in (("a.json", b'{"a": NaN}'), ("a.json", b'{"a": 1, "a": 2}'),
                          ("a.csv", b"a,b\n1\n"), ("a.csv", b"a,b\n\x1b,1\n"),
                          ("a.urdf", b"<robot>"), ("a.toml", b"a = 1\na = 2\n"),
                          ("a.html", b"\xff")):  # fmt: skip
        assert malformed(name, content)
