"""What each name is worth on whole arms, and what `diagnose` says where an effect is withheld.

    python experiment_design/blind_diagnosis/whole_without.py --seed S --worlds N

For each arm: the error at new poses of the diagnosed cell; how much it grows when one name of
those stated above 0.9 is taken out of that cell and the rest is fitted again (a name *pays* where
the error grows by 1 %); and the diagnosis with `--without` the kind that does most on that arm:
its verdict, names that are wrong, what it says is left, its error over that with the kind in.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from diagnose_many import run
from whole_draw import WholeRecipe
from whole_score import kind_of
from whole_world import judged
from world_files import write_world

SURE, PAYS = 0.9, 1.01
STANDS_FOR = {  # withheld for a true part of this family
    "load": ("link_mass_error", "gravity_sag", "link_weights", "torque_coupling", "torque_tilt"),
    "angle": ("gear_eccentricity", "gear_ripple", "gear_spectrum", "gear_second_harmonic"),
    "move": ("hysteresis", "backlash", "move_lag", "move_hysteresis"),
    "time": ("base_drift", "joint_drift", "thermal_expansion"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--poses", type=int, default=60)
    asked = parser.parse_args()
    head = ("arm", "error, mm", "names pay", "do not", "withheld", "verdict", "left, µm",
            "error over that with it in", "wrong names")  # fmt: skip
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|", flush=True)
    paid, stated, growth = 0, 0, []
    for k in range(asked.worlds):
        recipe = WholeRecipe(f"whole-{asked.poses}-{k:03d}", (asked.seed, 9, k), asked.poses)
        with tempfile.TemporaryDirectory() as name:
            arm = Arm(recipe, Path(name))
            error, gains = arm.error, arm.gains()
            idle = [f"{n} {g:.3f}" for n, g in gains.items() if g < PAYS]
            paid, stated = paid + len(gains) - len(idle), stated + len(gains)
            family, answer, found = arm.withheld()
            over = (found["tool_mm"] or np.nan) / error
            growth.append(over)
            wrong = [n["name"] for n in found["names"] if not n["right"]]
            left = answer["gap"]["unexplained_um"]
            cells = (
                k, f"{error:.4f}", f"{len(gains) - len(idle)} of {len(gains)}", ", ".join(idle),
                family, answer["verdict"], f"{left or 0:.0f}", f"{over:.2f}",
                f"{', '.join(wrong)} of {len(found['names'])}",
            )  # fmt: skip
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
    print(f"\nNames above {SURE} that pay: {paid} of {stated}; withheld, error over that with it: "
          f"median {np.nanmedian(growth):.2f}, largest {np.nanmax(growth):.2f}.")  # fmt: skip


class Arm:
    """A world written to files and diagnosed with all effects."""

    def __init__(self, recipe: WholeRecipe, folder: Path) -> None:
        self.world = recipe.draw()
        self.seen, self.sealed = folder / "seen", folder / "sealed"
        write_world(self.world, self.seen, self.sealed)
        self.answer = self._diagnosed("extended.toml")
        self.found = self._judged(self.answer, "extended.toml")
        self.error: float = self.found["tool_mm"]

    def gains(self) -> dict[str, float]:
        """Error at new poses without each sure name over that with all."""
        cell = (self.seen / "extended.toml").read_text()
        out = {}
        for e in self.answer["effects"]:
            name = f"{e['effect']}:{e['where']}"
            line = f'    "{name}",\n'
            if e["probability"] < SURE or line not in cell:
                continue
            (self.seen / "less.toml").write_text(cell.replace(line, ""))
            if self._run("identify", "less.toml", "data.csv", "--test", "new.csv", "-o", "r.json"):
                continue
            result = json.loads((self.seen / "r.json").read_text())
            out[name] = result["test"]["rms_um"] / 1e3 / self.error
        return out

    def withheld(self) -> tuple[str, Mapping[str, Any], Mapping[str, Any]]:
        """The diagnosis without the kind that does most, and what it is worth."""
        strong = max(self.found["strengths"].items(), key=lambda part: part[1])[0]
        family = kind_of(strong.partition(":")[0])
        without = [w for effect in STANDS_FOR[family] for w in ("--without", effect)]
        answer = self._diagnosed("less.toml", *without)
        return family, answer, self._judged(answer, "less.toml")

    def _diagnosed(self, out: str, *options: str) -> Mapping[str, Any]:
        files = ("cell.toml", "data.csv", "-o", "diagnosis.json", "--cell-out", out)
        if self._run("diagnose", *files, *options):
            raise RuntimeError(f"diagnose fails on {self.seen}")
        answer: Mapping[str, Any] = json.loads((self.seen / "diagnosis.json").read_text())
        return answer

    def _judged(self, answer: Mapping[str, Any], cell: str) -> dict[str, Any]:
        return judged(self.world, self.seen, self.sealed / "fresh.csv", self._run, answer, cell)

    def _run(self, *arguments: str) -> int:
        return int(str(run(str(self.seen), list(arguments))["exit"]))


if __name__ == "__main__":
    main()
