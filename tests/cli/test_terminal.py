"""The command line as a terminal's guest: completion, colours, Ctrl-C."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.exports import write_result
from support.robots import KR270

PROGRAM = "import sys; from elastocal.__main__ import main; sys.argv[0] = 'elastocal'; main()"
# What a shell's completion script sets, for "elastocal exp".
ASKED = {
    "bash": {"COMP_WORDS": "elastocal exp", "COMP_CWORD": "1"},
    "zsh": {"_TYPER_COMPLETE_ARGS": "elastocal exp"},
    "fish": {"_TYPER_COMPLETE_ARGS": "elastocal exp", "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
}


def elastocal(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("NO_COLOR", "FORCE_COLOR"))}
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=clean | environment)


@pytest.mark.parametrize("shell", ASKED)
def test_a_shell_completes_the_verbs_by_a_script_of_this_command(shell: str) -> None:
    done = elastocal(**ASKED[shell], _ELASTOCAL_COMPLETE=f"complete_{shell}")
    assert "export" in done.stdout and "identify" not in done.stdout and not done.stderr
    # Which shell is running cannot be seen from within a test; then it is asked for by name.
    off = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = elastocal("--show-completion", shell, **off)
    assert done.returncode == 0 and "_ELASTOCAL_COMPLETE" in done.stdout
    assert "python -m" not in done.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals of POSIX")
@pytest.mark.parametrize("colours", [True, False])
def test_no_color_is_obeyed_on_a_terminal(colours: bool, tmp_path: Path) -> None:
    import pty

    written = write_result(tmp_path, f'urdf = "{KR270}"', ["joint_offset", "joint_compliance"])
    command = [sys.executable, "-c", PROGRAM, "export", *map(str, written)]
    command += ["-o", str(tmp_path / "a.urdf"), "--load", "0", "0", "-100", "--poses", "5"]
    environment = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    environment |= {"TERM": "xterm-256color"} | ({} if colours else {"NO_COLOR": "1"})
    master, slave = pty.openpty()
    with subprocess.Popen(command, stdout=slave, stderr=slave, env=environment) as process:
        os.close(slave)
        told = b""
        while True:
            try:
                piece = os.read(master, 65536)
            except OSError:  # the other end is closed
                break
            if not piece:
                break
            told += piece
    os.close(master)
    assert process.returncode == 0 and b"wrote" in told
    # Colours are 30 to 37, 90 to 97, 38;… ; bold (1) is no colour.
    assert bool(re.search(rb"\x1b\[(?:\d+;)*(?:3[0-8]|9[0-7])", told)) == colours


@pytest.mark.parametrize("module", ["typer", "elastocal.model"])
def test_ctrl_c_while_the_command_is_loaded_ends_it_with_one_line(module: str) -> None:
    pressed = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Pressing:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Pressing())
"""
    done = subprocess.run(
        [sys.executable, "-c", pressed + PROGRAM, "demo"], capture_output=True, text=True
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "elastocal: interrupted\n"
