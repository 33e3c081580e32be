"""Commands that a page shows, run again, and what they print compared with what it shows.

A page shows a command and lines of its output in a block marked `console`: lines that begin with
"$ " are the commands (a line that ends in a backslash goes on), the others are output, "…" stands
for lines left out.  Run as a script it writes the numbers of a fresh run into the page:

    python docs/scripts/console_blocks.py docs/tutorial/index.md
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

BLOCK = re.compile(r"```console\n(.*?)```", re.S)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
LEFT_OUT = "…"


@dataclass(frozen=True)
class Shown:
    """A command of a page and the lines that the page shows of its output."""

    command: str
    lines: tuple[str, ...]


def shown(page: str) -> list[Shown]:
    """Every command of a page's console blocks, in order."""
    found: list[Shown] = []
    for block in BLOCK.findall(page):
        for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
            lines = part.rstrip().split("\n")
            n = 1 + next(i for i, line in enumerate(lines) if not line.endswith("\\"))
            found.append(Shown("\n".join(lines[:n]), tuple(lines[n:])))
    return found


def run(command: str, folder: Path) -> str:
    """What a command prints on stdout in `folder`; stderr and the exit code where it fails."""
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"$ {command}\nexit code {done.returncode}\n{done.stderr}")
    return done.stdout


def mask(line: str) -> str:
    """A line without its numbers and the widths of its columns."""
    return " ".join(re.sub("─+", "─", NUMBER.sub("#", line)).split())


def matched(lines: tuple[str, ...], output: str) -> list[str | None]:
    """For each shown line the line of `output` that it stands for, in order; None: none does."""
    actual = [line.rstrip() for line in output.splitlines()]
    found: list[str | None] = []
    at = 0
    for line in lines:
        if not line.strip() or line.strip() == LEFT_OUT:
            found.append(line)
            continue
        here = next((i for i in range(at, len(actual)) if mask(actual[i]) == mask(line)), None)
        found.append(None if here is None else actual[here])
        at = at if here is None else here + 1
    return found


def differences(piece: Shown, output: str, share: float = 0.02) -> list[str]:
    """Shown lines that the output lacks, or whose numbers differ by more than `share` of
    themselves and one unit of the last digit shown."""
    told = []
    for line, actual in zip(piece.lines, matched(piece.lines, output), strict=True):
        if actual is None:
            told.append(f"not printed: {line}")
        elif not all(
            _close(a, b, share)
            for a, b in zip(NUMBER.findall(line), NUMBER.findall(actual), strict=True)
        ):
            told.append(f"shown:   {line}\nprinted: {actual}")
    return told


def _close(shown: str, printed: str, share: float) -> bool:
    decimals = len(shown.partition(".")[2]) if "e" not in shown else 0
    last = 10.0**-decimals if "." in shown else 1.0
    return abs(float(shown) - float(printed)) <= share * abs(float(shown)) + 1.001 * last


def refreshed(page: str, outputs: list[str]) -> str:
    """The page with the lines that a fresh run printed; `outputs` of each of its commands."""
    for piece, output in zip(shown(page), outputs, strict=True):
        new = matched(piece.lines, output)
        lost = [line for line, found in zip(piece.lines, new, strict=True) if found is None]
        if lost:
            raise RuntimeError(f"$ {piece.command}\nno longer prints:\n" + "\n".join(lost))
        before = "\n".join((piece.command, *piece.lines))
        page = page.replace(before, "\n".join((piece.command, *(f or "" for f in new))), 1)
    return page


def shim(folder: Path) -> None:
    """Make `elastocal` in `folder` this interpreter's, whatever is installed."""
    script = folder / "elastocal"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m elastocal "$@"\n', encoding="utf-8")
    script.chmod(0o755)
    os.environ["PATH"] = f"{folder}{os.pathsep}{os.environ['PATH']}"


if __name__ == "__main__":
    import shutil
    import tempfile

    path = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as name:
        work = Path(name) / "work"
        shutil.copytree(path.parent, work)
        shim(Path(name))
        text = path.read_text(encoding="utf-8")
        printed = [run(piece.command, work) for piece in shown(text)]
    path.write_text(refreshed(text, printed), encoding="utf-8")
