"""Whole arms one by one, without the study: a line for each, at once.

    python experiment_design/blind_diagnosis/whole_arms.py --seed S --worlds N --poses 60

Rms errors at 200 new poses and loads, in mm: of the cell's own model, of what `diagnose --cell-out`
added, both by `identify --test`; of the oracle; their ratio, what is claimed and how long it took.
`--withhold` diagnoses each arm once more without the kind of effect that does most on
it, and prints its verdict, its wrong names, and its error over that with the kind in.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from whole_draw import WholeRecipe
from whole_score import judged, kind_of, over_oracle
from worker import run
from world_files import write_world

COLUMNS = (
    "world", "arm", "noise, µm", "approach told", "geometry, mm", "as diagnosed", "oracle", "ratio",
    "s", "verdict", "shares held", "wrong names", "missed", "named",
)  # fmt: skip
WITHHELD = ("withheld", "verdict without", "wrong names", "error over that with it")
STANDS_FOR = {  # withheld for a true part of this kind
    "load": ("link_mass_error", "gravity_sag", "link_weights", "torque_coupling", "torque_tilt"),
    "angle": ("gear_eccentricity", "gear_ripple", "gear_spectrum", "gear_second_harmonic"),
    "move": ("hysteresis", "backlash", "move_lag", "move_hysteresis"),
    "time": ("base_drift", "joint_drift", "thermal_expansion"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=5)
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--withhold", action="store_true")
    asked = parser.parse_args()
    head = COLUMNS + WITHHELD * asked.withhold
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}", flush=True)
    ratios = []
    for k in range(asked.worlds):
        recipe = WholeRecipe(f"whole-{asked.poses}-{k:03d}", (asked.seed, 9, k), asked.poses)
        with tempfile.TemporaryDirectory() as folder:
            cells, ratio = one_world(recipe, Path(folder), asked.withhold)
        print(f"| {' | '.join([str(k), *cells])} |", flush=True)
        ratios.append(ratio)
    known = np.array([r for r in ratios if np.isfinite(r)])
    if len(known):
        print(f"\nRatio: median {np.median(known):.2f}, 90 % {np.quantile(known, 0.9):.2f}.")


def one_world(recipe: WholeRecipe, folder: Path, withhold: bool) -> tuple[list[str], float]:
    """Its row, and the tool's error over the oracle's."""
    world = recipe.draw()
    observed, sealed = folder / "seen", folder / "sealed"
    write_world(world, observed, sealed)

    def diagnosed(out: str, *more: str) -> tuple[Mapping[str, Any] | None, dict[str, Any], float]:
        options = ("-o", "diagnosis.json", "--cell-out", out, *more)
        done, answer = run(observed, "diagnose", "cell.toml", "data.csv", *options), None
        if done.exit == 0:
            answer = json.loads((observed / "diagnosis.json").read_text(encoding="utf-8"))
        else:
            print(done.message.strip()[-300:], file=sys.stderr, flush=True)
        return answer, judged(world, observed, sealed / "fresh.csv", answer, out), done.seconds

    answer, whole, seconds = diagnosed("extended.toml")
    errors = [whole[key] or np.nan for key in ("geometry_mm", "tool_mm", "oracle_mm")]
    ratio = over_oracle(whole)
    cells = [world.spec.name, f"{1e6 * world.noise.level:.0f}"]
    cells += ["yes" if world.told.approach else "no", *(f"{e:.4f}" for e in errors)]
    cells += [f"{ratio:.2f}", f"{seconds:.0f}", *said(answer, whole)]
    if withhold:
        kind = kind_of(max(whole["strengths"].items(), key=lambda part: part[1])[0].split(":")[0])
        without = [w for effect in STANDS_FOR[kind] for w in ("--without", effect)]
        less, found, _ = diagnosed("less.toml", *without)
        verdict, _, wrong, *_ = said(less, found)
        cells += [kind, verdict, wrong, f"{(found['tool_mm'] or np.nan) / errors[1]:.2f}"]
    return cells, ratio


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
