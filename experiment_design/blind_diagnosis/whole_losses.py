"""What the answer to a whole arm left out, and what that costs at new poses.

    python experiment_design/blind_diagnosis/whole_arms.py --seed S --worlds N --keep FOLDER
    python experiment_design/blind_diagnosis/whole_losses.py FOLDER --seed S

A line per arm: the tool's error over the oracle's; that of an oracle whose columns are those of
the effects alone that the tool names (sag by moments of each joint's own, or by those that all
joints share), with the true orders, noise, scatter and priors; and what is left out, by how much
each in µm would lower that error (root of the fall of the mean square).  Where the first two agree,
structure is what is missing.  Then the error of one who searches for orders (`whole_search.py`)
where he is given those that the tool wrote, and where he adds the families that he finds himself
at joints without one: what the tool's orders cost, and what the families cost that it missed.
"""

from __future__ import annotations

import argparse
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from whole_columns import moments
from whole_draw import WholeRecipe
from whole_laws import LAST_MOVE, LINES, WEIGHTS
from whole_oracle import Block, Sights, effects, error_of, geometry
from whole_search import Search, searched

Unit = tuple[str, str]  # what it is, and where
# Which of them an effect of elastocal stands for.
STANDS_FOR = {
    "gear_eccentricity": ("eccentricity",), "gear_spectrum": ("lines",), "gear_ripple": ("lines",),
    "joint_curve": ("eccentricity", "lines"), "gravity_sag": ("sag",), "move_lag": ("move",),
    "hysteresis": ("move",), "base_drift": ("creep",), "residual_field": ("creep",),
    "link_weights": ("sag",), "move_hysteresis": ("move",),
}  # fmt: skip
SHOWN = 6


def units(sights: Sights) -> dict[Unit, list[Block]]:
    """Columns of every single thing that is wrong with the arm."""
    world, every = sights.world, effects(sights)
    out: dict[Unit, list[Block]] = {}
    for e in world.effects:
        if e.name == LINES:
            for line in e.settings:
                kind = "eccentricity" if line == "eccentricity" else "lines"
                out.setdefault((kind, e.where), []).append(next(every))
        elif e.name == WEIGHTS:
            out["sag", "arm"] = [shared := next(every)]
            for j, k in enumerate(world.specimen.true.compliance):
                here, there = (
                    at.joint[:, :, j, None] * k * at.weighing[:, j][:, None]
                    for at in (sights.at_here, sights.at_there)
                )
                own = Block(here, there, shared.deviation, moments(e))
                out["sag", f"joint{j + 1}"] = [own]
        else:
            kind = "move" if e.name == LAST_MOVE else "creep"
            out[kind, e.where] = [next(every)]
    return out


def fitted_geometry(sights: Sights) -> list[Block]:
    """With compliances that answer to the payload alone: weights are in the sag."""
    *frames, springs = geometry(sights)
    here, there = (at.joint * at.carried[:, None] for at in (sights.at_here, sights.at_there))
    return [*frames, replace(springs, here=here, there=there)]


def named(answer: Mapping[str, Any], every: Iterable[Unit]) -> set[Unit]:
    found = [*answer["effects"], *(answer.get("slight") or ()), *(answer.get("fields") or ())]
    said = {(kind, e["where"]) for e in found for kind in STANDS_FOR.get(e["effect"], ())}
    return said & set(every)


def losses(sights: Sights, answer: Mapping[str, Any]) -> tuple[float, list[tuple[float, Unit]]]:
    """Rms length (m) of the error with what is named, and by how much (m) each thing that is left
    out would lower it."""
    every = units(sights)
    chosen = named(answer, every)
    shared = ("sag", "arm")
    if shared in chosen:
        chosen -= {u for u in every if u[0] == "sag" and u != shared}
        every = {u: b for u, b in every.items() if u[0] != "sag" or u == shared}
    else:
        del every[shared]
    left = set(every) - chosen

    def error(known: set[Unit]) -> float:
        rest = [b for u in every if u not in known for b in every[u]]
        fitted = [b for u in every if u in known for b in every[u]]
        return error_of(sights, [*fitted_geometry(sights), *fitted], rest)

    whole = error(chosen)
    falls = ((whole**2 - error(chosen | {u}) ** 2, u) for u in left)
    return whole, sorted(((float(np.sqrt(max(f, 0.0))), u) for f, u in falls), reverse=True)


def family_losses(sights: Sights, cell: Path) -> tuple[float, float]:
    """Rms lengths (m) of a searcher's error with the families of lines of a cell, and with those
    that he finds at other joints as well."""
    stated = tomllib.loads(cell.read_text(encoding="utf-8"))["model"]["nominal"]
    known = stated.get("settings", {}).items()
    told = {int(w.removeprefix("joint")) - 1: s["order_1"] for w, s in known if "order_1" in s}
    search = Search(sights)
    return search.error(told), search.error(searched(sights)[1] | told)


def lines(folder: Path, seed: int) -> Iterator[str]:
    for path in sorted(folder.glob("whole-*/judged.json")):
        _, poses, number = path.parent.name.split("-")
        world = WholeRecipe("", (seed, 9, int(number)), int(poses)).draw()
        answer = json.loads((path.parent / "seen" / "diagnosis.json").read_text(encoding="utf-8"))
        judged = json.loads(path.read_text(encoding="utf-8"))
        sights = Sights.of(world)
        error, left = losses(sights, answer)
        own, more = family_losses(sights, path.parent / "seen" / "extended.toml")
        told = ", ".join(f"{k} {w} {1e6 * fall:.0f}" for fall, (k, w) in left[:SHOWN])
        tool = np.nan if judged["tool_mm"] is None else judged["tool_mm"]
        oracle = judged["oracle_mm"]
        yield (
            f"{path.parent.name}: tool {tool / oracle:.2f} of the oracle's, its structure alone "
            f"{1e3 * error / oracle:.2f}; left out, µm: {told}; searching with its families "
            f"{1e3 * own / oracle:.2f}, with others as well {1e3 * more / oracle:.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    for line in lines(asked.folder, asked.seed):
        print(line, flush=True)
