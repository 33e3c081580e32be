"""Whole arms one by one, without the study: a line for each, at once.

    python experiment_design/blind_diagnosis/whole_arms.py --seed S --worlds N --poses 60

Rms errors at 200 new poses and loads, in mm: of the cell's own model, of what `diagnose --cell-out`
added, both by `identify --test`; of the oracle; their ratio, what is claimed and how long it took.
With `--keep FOLDER` cell, readings and answers stay there, with the truth; `--first K` begins with
world K.  Blindness is the study's matter: here all runs in one process.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from diagnose_many import run
from whole_draw import WholeRecipe
from whole_oracle import Sights, gap_of, oracle_error
from whole_score import score_parts
from world_files import write_world

HEAD = (
    f"{'world':>5} {'arm':<10} {'noise':>5} {'told':<5} {'geometry':>8} {'tool':>7} {'oracle':>7} "
    f"{'ratio':>6} {'geo/or':>6} {'s':>6}  verdict; shares held, wrong names, missed; named"
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
        print(f"{k:5d} {line}", flush=True)
        ratios.append(ratio)
    known = np.array([r for r in ratios if np.isfinite(r)])
    if len(known):
        print(f"ratio: median {np.median(known):.2f}, 90 % {np.quantile(known, 0.9):.2f}")


def one_world(recipe: WholeRecipe, folder: Path) -> tuple[str, float]:
    """Its line, and the tool's error over the oracle's."""
    world = recipe.draw()
    observed, sealed = folder / "seen", folder / "sealed"
    write_world(world, observed, sealed)
    sights = Sights.of(world)
    oracle = 1e3 * oracle_error(sights)
    options = ["-o", "diagnosis.json", "--cell-out", "extended.toml"]
    done = run(str(observed), ["diagnose", "cell.toml", "data.csv", *options])
    shutil.copyfile(sealed / "fresh.csv", observed / "new.csv")
    geometry = test_error(observed, "cell.toml")
    tool, answer = float("nan"), None
    if done["exit"] == 0:
        answer = json.loads((observed / "diagnosis.json").read_text(encoding="utf-8"))
        tool = test_error(observed, "extended.toml")
    told = "came" if world.told.approach else "-"
    line = (
        f"{world.spec.name:<10} {1e6 * world.noise.level:5.0f} {told:<5} "
        f"{geometry:8.4f} {tool:7.4f} {oracle:7.4f} {tool / oracle:6.2f} "
        f"{geometry / oracle:6.1f} {done['seconds']:6.1f}  "
    )
    return line + said(answer, str(done["message"]), sights), tool / oracle


def said(answer: dict | None, message: str, sights: Sights) -> str:
    """What is claimed, and how right that is."""
    if answer is None:
        return "failed: " + message.strip().splitlines()[-1][:120]
    scored = score_parts(gap_of(sights), answer)
    names = ", ".join(f"{e['effect']}:{e['where']}" for e in answer["effects"])
    held = f"{sum(p.held for p in scored.shares)}/{len(scored.shares)}"
    wrong = f"{sum(not right for _, right in scored.names)}/{len(scored.names)}"
    return f"{answer['verdict']}; {held}, {wrong}, {len(scored.missed)}; {names or 'nothing'}"


def test_error(folder: Path, cell: str) -> float:
    """Rms error in mm of `identify CELL data.csv --test new.csv`; nan where it fails."""
    done = run(
        str(folder), ["identify", cell, "data.csv", "--test", "new.csv", "-o", "result.json"]
    )
    if done["exit"] != 0:
        print(f"      identify {cell}: {str(done['message']).strip()[-300:]}", flush=True)
        return float("nan")
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    return float(result["test"]["rms_um"]) / 1e3


if __name__ == "__main__":
    main()
