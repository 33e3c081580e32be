"""Writes the campaign of the README's example: one world, its truth beside it for once.

python experiment_design/blind_diagnosis/example.py
"""

from __future__ import annotations

from pathlib import Path

from draw import Recipe
from world_files import write_world

HERE = Path(__file__).resolve().parent


def main() -> None:
    recipe = Recipe("example", (2026, 11), ("backlash",), arm="heavy", level=25e-6)
    write_world(recipe.draw(), HERE / "example", HERE / "example_truth")


if __name__ == "__main__":
    main()
