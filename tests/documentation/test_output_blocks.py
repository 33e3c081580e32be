"""What README and how-to pages show of commands is what the commands print."""

import os
import shutil
from pathlib import Path

import console_blocks
import pytest
from documentation.conftest import ran

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorial"
SLOW = ("design", "diagnose")
WHOLE_SEARCH = True  # a plan is shown in the order that the command finds
PIECES = {
    f"{page}: {piece.command.split()[1]}": piece
    for page in ("README.md", "docs/beginning.md", "docs/exporting.md")
    for piece in console_blocks.shown((ROOT / page).read_text(encoding="utf-8"))
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A checkout after `make demo`, with the tutorial's files beside."""
    made = tmp_path_factory.mktemp("blocks")
    work = made / "work"
    shutil.copytree(TUTORIAL, work)
    (work / "experiment_design").symlink_to(ROOT / "experiment_design")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", os.environ["PATH"])  # put back what shim changes
        console_blocks.shim(made)
        patch.setattr("elastocal.report.renderers.write_page", lambda *found, **more: None)
        ran("elastocal demo -q", work)
        yield work


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] if piece.command.split()[1] in SLOW else [])
        for name, piece in PIECES.items()
    ],
)
def test_the_block_is_what_the_command_prints(name, folder):
    piece = PIECES[name]
    told = console_blocks.differences(piece, ran(piece.command, folder))
    assert not told, "\n".join([f"$ {piece.command}", *told])
