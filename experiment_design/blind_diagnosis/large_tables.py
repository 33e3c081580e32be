"""How much of a large table a diagnosis needs: weak effects in 10,000 readings, from all and fewer.

    python experiment_design/blind_diagnosis/large_tables.py --seed S --factor 0.1 --worlds N

Arms of the blind check with one effect of the catalogue at `--factor` times its realistic size,
1667 poses under two loads with three markers, diagnosed from at most so many of the readings
(`--rows`), configurations evenly spaced.  A line for each: what is said, the probability of what
is named, how far the error is said to shrink by it, and the CPU time.  Blindness is the study's
matter: here all runs in one process.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from draw import CATALOGUE, Recipe
from score import one_effect
from world_files import write_world

import elastocal
from elastocal.diagnosis.baseline import thinned

POSES = 1667


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--factor", type=float, default=0.1)
    parser.add_argument("--worlds", type=int, default=len(CATALOGUE), help="effects, in order")
    parser.add_argument("--rows", type=int, nargs="+", default=[12_000, 5000])
    asked = parser.parse_args()
    print("| effect | rows | CPU, s | outcome | said |\n" + "|---" * 5 + "|", flush=True)
    outcomes: dict[int, list[str]] = {rows: [] for rows in asked.rows}
    for k in range(asked.worlds):
        name = CATALOGUE[k % len(CATALOGUE)]
        recipe = Recipe(f"{name}-{k}", (asked.seed, 12, k), (name,), asked.factor, POSES)
        with tempfile.TemporaryDirectory() as folder:
            seen, sealed = Path(folder, "seen"), Path(folder, "sealed")
            write_world(recipe.draw(), seen, sealed)
            truth = json.loads((sealed / "truth.json").read_text(encoding="utf-8"))
            for rows in asked.rows:
                outcome, line = from_part(seen, truth, rows)
                outcomes[rows].append(outcome)
                print(f"| {name}:{truth['effects'][0]['where']} | {rows} | {line} |", flush=True)
    for rows, each in outcomes.items():
        counted = ", ".join(f"{each.count(o)} {o}" for o in sorted(set(each)))
        print(f"\nfrom {rows} readings at most: {counted}")


def from_part(seen: Path, truth: dict[str, object], rows: int) -> tuple[str, str]:
    """What the diagnosis says from so many readings at most: its outcome, and the line."""
    model = elastocal.Model(seen / "cell.toml")
    table, _ = thinned(model.read(seen / "data.csv"), rows)
    start = time.process_time()
    diagnosis = elastocal.diagnose(model, table)
    seconds = time.process_time() - start
    diagnosis.save(seen / f"{rows}.json")
    answer = json.loads((seen / f"{rows}.json").read_text(encoding="utf-8"))
    outcome = one_effect(truth, answer)
    named = "; ".join(
        f"{e['effect']}:{e['where']} {e['probability']:.3f}, shrinks by {e['gap_reduction']:.4f}"
        for e in answer["effects"]
    )
    return outcome, f"{seconds:.0f} | {outcome} | {answer['verdict']} {named}"


if __name__ == "__main__":
    main()
