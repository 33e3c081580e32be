"""What the documentation shows is what the tool accepts."""

import re
from pathlib import Path

from support.robots import KR270

from elastocal.cell_reader import read_cell
from elastocal.manipulator.effects import CATALOGUE
from elastocal.manipulator.model import Model

ROOT = Path(__file__).parents[1]


def toml_blocks(page: str) -> list[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"```toml\n(.*?)```", text, re.S)


def test_every_cell_shown_is_a_cell(tmp_path):
    blocks = toml_blocks("README.md") + toml_blocks("docs/file-formats.md")
    assert len(blocks) == 2
    (tmp_path / "arm.urdf").write_text(KR270.read_text(encoding="utf-8"), encoding="utf-8")
    for block in blocks:
        path = tmp_path / "cell.toml"
        path.write_text(block, encoding="utf-8")
        model = Model.from_cell(read_cell(path, known_effects=tuple(CATALOGUE)))
        assert model.parameters


def test_links_between_pages_lead_somewhere():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
