"""The picture of the house shows every package, and every arrow of it leads downwards."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "house.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def house():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(ROOT / "docs" / "figures"), *sys.path])
        import house

        return house


@pytest.fixture(scope="module")
def uses(house):
    return house.uses()


def test_every_package_and_module_has_a_line_of_the_table_and_packages_a_room(house):
    source = ROOT / "src" / "elastocal"
    packages = {path.parent.name for path in source.glob("*/__init__.py")}
    modules = {path.name for path in source.glob("*.py") if not path.name.startswith("__")}
    table = PAGE.split("## Packages and modules")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    told = re.findall(r"`([\w.]+)`", " ".join(cells))
    assert sorted(told) == sorted(packages | modules)
    assert packages - {"demo"} <= set(house.ROOMS)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_picture_shows_the_imports_of_today(uses, scheme):
    picture = (ROOT / "docs" / "images" / f"house_{scheme}.svg").read_text(encoding="utf-8")
    arrows = {f"{room} uses {one}" for room, direct in uses.items() for one in direct}
    assert set(re.findall(r'id="(\w+_uses_\w+)"', picture)) == {a.replace(" ", "_") for a in arrows}
