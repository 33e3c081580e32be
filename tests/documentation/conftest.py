"""The tutorial's commands, run once for all tests of the documentation."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from support.design_commands import elastocal

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorial"
for folder in ("scripts", "hooks"):
    sys.path.insert(0, str(ROOT / "docs" / folder))


@dataclass(frozen=True)
class Course:
    """`printed` by each command, the result file as every `identify` left it, and the folder."""

    printed: list[str]
    results: list[dict]
    folder: Path


def ran(command: str, folder: Path) -> str:
    """What a shell prints of a command; ours runs in this process, where it stands alone."""
    import console_blocks

    words = shlex.split(command.replace("\\\n", " "))
    if words[0] != "elastocal" or {"|", ">", ">>", "&&", ";"} & {*words}:
        return console_blocks.run(command, folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        done = elastocal(*words[1:], COLUMNS="100", NO_COLOR="1")
    assert done.exit_code == 0, f"$ {command}\n{done.output}"
    return done.stdout


@pytest.fixture(scope="session")
def course(tmp_path_factory):
    import console_blocks

    folder = tmp_path_factory.mktemp("tutorial")
    work = folder / "work"
    shutil.copytree(TUTORIAL, work)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", os.environ["PATH"])  # put back what shim changes
        console_blocks.shim(folder)
        printed, results = [], []
        for piece in console_blocks.shown((TUTORIAL / "index.md").read_text(encoding="utf-8")):
            printed.append(ran(piece.command, work))
            if piece.command.startswith("elastocal identify"):
                results.append(json.loads((work / "result.json").read_text(encoding="utf-8")))
    return Course(printed, results, work)
