"""What a diagnosed cell promises at new poses beside what it does there, on real arms.

ELASTOCAL_DATASETS=… python promises.py            writes promises.md, out/promise_*
ELASTOCAL_DATASETS=… python promises.py irb120 ur5 runs these arms again, keeps the others

Each table is split: at random, by blocks of rows, at random after its rows were shuffled, or every
second row.  The cell is identified on the one part before and after a diagnosis of it; what it
promises is the held-out error of that fit, what is found the error of the other part's poses.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from diagnose import OUT, elastocal, identified, mm, read
from prepare import HERE, prepare

FAULTY = (142, 507)  # lines of the cable's table: README.md
BLOCKS = 10


@dataclass(frozen=True)
class Split:
    """`most`: configurations that are fitted at most, evenly from those of the part."""

    arm: str
    cell: str
    table: str
    way: str
    seed: int
    most: int = 400

    @property
    def stem(self) -> str:
        return f"promise_{self.arm}_{self.way}_{self.seed}"

    def write(self, data: Path) -> tuple[Path, Path]:
        """Tables to fit and to test."""
        header, *lines = (data / self.table).read_text(encoding="utf-8").splitlines()
        if self.arm == "irb120":
            lines = [v for k, v in enumerate(lines, 2) if not FAULTY[0] <= k <= FAULTY[1]]
        at = header.split(",").index("configuration") if "configuration" in header else None
        groups: dict[object, list[str]] = {}
        for k, line in enumerate(lines):
            groups.setdefault(k if at is None else line.split(",")[at], []).append(line)
        rng, rows = np.random.default_rng(self.seed), list(groups.values())
        if self.way == "shuffled":
            rows = [rows[k] for k in rng.permutation(len(rows))]
        place = np.arange(len(rows))
        if self.way in ("random", "shuffled"):
            fit = rng.permutation(len(rows)) < 0.75 * len(rows)
        elif self.way == "blocks":
            fit = (place * BLOCKS // len(rows) + self.seed) % 4 > 0
        else:
            fit = place % 2 == self.seed % 2
        chosen = np.flatnonzero(fit)
        if len(chosen) > self.most:
            chosen = chosen[np.linspace(0, len(chosen) - 1, self.most).round().astype(int)]
        paths = OUT / f"{self.stem}_fit.csv", OUT / f"{self.stem}_test.csv"
        for path, part in zip(paths, (chosen, np.flatnonzero(~fit)), strict=True):
            kept = [line for k in part for line in rows[k]]
            path.write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")
        return paths


ARMS = {
    "ur10": ("ur10.toml", "ur10_3000.csv"),
    "ur5": ("ur5.toml", "ur5_grid.csv"),
    "wam": ("wam.toml", "wam_grid.csv"),
    "iiwa7": ("iiwa7_rigid.toml", "iiwa7.csv"),
    "irb120": ("irb120.toml", "irb120.csv"),
}
WAYS = (("random", 1), ("blocks", 0), ("shuffled", 2), ("second", 0))


def splits(arm: str) -> Iterator[Split]:
    ways = [*WAYS, ("random", 3), ("blocks", 2)] if arm == "irb120" else WAYS
    for way, seed in ways:
        yield Split(arm, *ARMS[arm], way, seed)


def measure(split: Split, data: Path) -> dict[str, float]:
    fit, test = split.write(data)
    cell = OUT / f"{split.stem}.toml"
    out = OUT / f"{split.stem}.json"
    elastocal("diagnose", HERE / split.cell, fit, "-o", out, "--cell-out", cell)
    found: dict[str, float] = {}
    for when, path in (("before", HERE / split.cell), ("after", cell)):
        result = identified(path, fit, f"{split.stem}_{when}", "--test", test)
        found |= {
            f"{when}_promised": result["heldout_rms_um"], f"{when}_found": result["test"]["rms_um"]
        }  # fmt: skip
    diagnosis = read(out)
    budget = [s["heldout_rms_um"] for s in diagnosis["budget"][:-1]]
    return found | {"diagnosed": budget[-1], "verdict": diagnosis["verdict"]}


def row(split: Split, found: dict[str, float]) -> str:
    before, after = (
        (mm(said), mm(true), f"{true / said:.2f}")
        for said, true in (
            (found[f"{w}_promised"], found[f"{w}_found"]) for w in ("before", "after")
        )
    )
    values = f"{split.way} {split.seed}", str(found["verdict"]), *before, mm(found["diagnosed"])
    return f"| {' | '.join((split.arm, *values, *after))} |"


HEAD = (
    "| arm | split | verdict | geometry: promised | found | ratio | diagnosis promised "
    "| its cell: promised | found | ratio |\n|---|---|---|---|---|---|---|---|---|---|"
)


def main(chosen: list[str]) -> None:
    data = prepare()
    OUT.mkdir(exist_ok=True)
    print(HEAD)
    rows, ratios = [HEAD], []
    for split in (split for arm in ARMS for split in splits(arm)):
        kept = OUT / f"{split.stem}_measured.json"
        if not chosen or split.arm in chosen:
            kept.write_text(json.dumps(measure(split, data)), encoding="utf-8")
            print(row(split, read(kept)), flush=True)
        if kept.is_file():
            rows.append(row(split, read(kept)))
            ratios.append(read(kept)["after_found"] / read(kept)["after_promised"])
    last = f"Found over promised by the diagnosed cell: {median(ratios):.2f} in the median."
    (HERE / "promises.md").write_text("\n".join([*rows, "", last]) + "\n", encoding="utf-8")
    print(f"\n{last}")


if __name__ == "__main__":
    main(sys.argv[1:])
