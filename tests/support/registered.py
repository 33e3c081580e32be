"""Plug-ins as the pages show them, and registries that forget them again."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from elastocal import files
from elastocal.identification import noise_structure as structure
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.planning.criteria import CRITERIA

DOCS = Path(__file__).parents[2] / "docs"


def example(page: str, file: str) -> str:
    """The code block of a page that stands behind the mention of its file's name."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found = re.search(rf"`{file}`:\n+```python\n(.*?)^```", text, re.M | re.S)
    assert found, f"{page} shows no {file}"
    return found[1]


EXAMPLES = {
    "three_lobes.py": "adding-an-effect.md",
    "settling_joint.py": "adding-an-effect.md",
    "noise_by_day.py": "adding-a-noise-model.md",
}


def write_example(folder: Path, file: str) -> Path:
    path = folder / file
    path.write_text(example(EXAMPLES[file], file), encoding="utf-8")
    return path


@contextmanager
def forgotten() -> Iterator[None]:
    """Catalogue, noise models, criteria and files that were run are afterwards as before."""
    registries = (CATALOGUE, structure.STRUCTURES, CRITERIA, files.RAN)
    before = [dict(each) for each in registries]
    try:
        yield
    finally:
        for each, content in zip(registries, before, strict=True):
            each.clear()  # type: ignore[attr-defined]
            each.update(content)  # type: ignore[attr-defined]
