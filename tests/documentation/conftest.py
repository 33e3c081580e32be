"""The tutorial's commands, run once for all tests of the documentation."""

import json
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

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
            printed.append(console_blocks.run(piece.command, work))
            if piece.command.startswith("elastocal identify"):
                results.append(json.loads((work / "result.json").read_text(encoding="utf-8")))
    return Course(printed, results, work)
