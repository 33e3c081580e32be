"""Whole arms one by one, without the study: a line for each, at once.

    python experiment_design/blind_diagnosis/whole_arms.py --seed S --worlds N --poses 60

Rms errors at 200 new poses and loads, in mm: of the cell's own model, of what `diagnose --cell-out`
added, both by `identify --test`; of the oracle; their ratio, what is claimed and how long it took.
With `--keep FOLDER` cell, readings and answers stay there, with the truth; `--first K` begins with
world K.
Blindness is the study's matter: here all runs in one process.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from diagnose_many import run
from whole_draw import WholeRecipe
from whole_world import judged, over_oracle
from world_files import write_world

HEAD = (
    "| world | arm | noise, µm | approach told | geometry, mm | as diagnosed | oracle | ratio "
    "| s | verdict | shares held | wrong names | missed | named |\n" + "|" + "---|" * 14
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    print(HEAD, flush=True)
    ratios = []
    for k in range(asked.first, asked.first + asked.worlds):
        recipe = WholeRecipe(f"whole-{asked.poses}-{k:03d}", (asked.seed, 9, k), asked.poses)
        folder = Path(tempfile.mkdtemp()) if asked.keep is None else asked.keep / recipe.name
        try:
            line, ratio = one_world(recipe, folder)
        finally:
            if asked.keep is None:
                shutil.rmtree(folder)
        print(f"| {k} | {line} |", flush=True)
        ratios.append(ratio)
    known = np.array([r for r in ratios if np.isfinite(r)])
    if len(known):
        print(f"\nRatio: median {np.median(known):.2f}, 90 % {np.quantile(known, 0.9):.2f}.")


def one_world(recipe: WholeRecipe, folder: Path) -> tuple[str, float]:
    """Its row, and the tool's error over the oracle's."""
    world = recipe.draw()
    observed, sealed = folder / "seen", folder / "sealed"
    write_world(world, observed, sealed)

    def command(*arguments: str) -> int:
        done = run(str(observed), list(arguments))
        if done["exit"] != 0:
            told = str(done["message"]).strip()[-300:]
            print(f"{arguments[0]}: {told}", file=sys.stderr, flush=True)
        return int(str(done["exit"]))

    start, answer = time.perf_counter(), None
    options = ("-o", "diagnosis.json", "--cell-out", "extended.toml")
    if command("diagnose", "cell.toml", "data.csv", *options) == 0:
        answer = json.loads((observed / "diagnosis.json").read_text(encoding="utf-8"))
    seconds = time.perf_counter() - start
    whole = judged(world, observed, sealed / "fresh.csv", command, answer, "extended.toml")
    (folder / "judged.json").write_text(json.dumps(whole, indent=2), encoding="utf-8")
    errors = [whole[key] or np.nan for key in ("geometry_mm", "tool_mm", "oracle_mm")]
    ratio = over_oracle(whole)
    parts = [
        world.spec.name,
        f"{1e6 * world.noise.level:.0f}",
        "yes" if world.told.approach else "no",
    ]
    parts += [*(f"{e:.4f}" for e in errors), f"{ratio:.2f}", f"{seconds:.0f}"]
    return " | ".join(parts + said(answer, whole)), ratio


def said(answer: Mapping[str, Any] | None, whole: Mapping[str, Any]) -> list[str]:
    """What is claimed, and how right that is."""
    if answer is None:
        return ["failed", "–", "–", "–", "–"]
    names = ", ".join(f"{e['effect']}:{e['where']}" for e in answer["effects"])
    held = f"{sum(s['held'] for s in whole['shares'])} of {len(whole['shares'])}"
    wrong = f"{sum(not n['right'] for n in whole['names'])} of {len(whole['names'])}"
    return [answer["verdict"], held, wrong, str(len(whole["missed"])), names or "nothing"]


if __name__ == "__main__":
    main()
