"""Diagnose the real arms of the public data sets, by elastocal's own command line.

ELASTOCAL_DATASETS=… python diagnose.py      writes diagnosis.md, out/diagnosis_*.json and *.html
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prepare import HERE, prepare

OUT = HERE / "out"
SHOWN = 5  # candidates of a set
CERTAIN = 0.995


@dataclass(frozen=True)
class Run:
    """`table` is diagnosed; where there is a `test` table, the cell is identified before and after
    the diagnosis and predicts its poses.  `clean` leaves out the readings that `identify` does."""

    label: str
    cell: str
    table: str
    test: str | None = None
    clean: bool = False

    @property
    def stem(self) -> str:
        return f"diagnosis_{Path(self.cell).stem}{'_clean' * self.clean}"


RUNS = (
    Run("iiwa 7, rigid", "iiwa7_rigid.toml", "iiwa7.csv"),
    Run("iiwa 7, rigid, encoder scales", "iiwa7_rigid_scale.toml", "iiwa7.csv"),
    Run("UR5, 1000 poses", "ur5.toml", "ur5_grid.csv", "ur5_random.csv"),
    Run("WAM, 216 poses", "wam.toml", "wam_grid.csv", "wam_random.csv"),
    Run("IRB 120 by cable, as is", "irb120.toml", "irb120.csv"),
    Run("IRB 120 by cable, faulty left out", "irb120.toml", "irb120.csv", clean=True),
)
GAPS = ("nominal", "calibrated", "explained", "noise_floor")
SUMMARY = (
    "| run | verdict | nominal | calibrated | with the named effects | noise floor "
    "| test poses, before → after | s |\n|---|---|---|---|---|---|---|---|"
)


def elastocal(*arguments: object) -> None:
    """Run the command line; raises CalledProcessError where it fails."""
    command = [sys.executable, "-m", "elastocal", *map(str, arguments), "--quiet"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def identified(cell: Path, table: Path, name: str, *options: object) -> dict[str, Any]:
    result = OUT / f"{name}.json"
    elastocal("identify", cell, table, "-o", result, *options)
    return json.loads(result.read_text(encoding="utf-8"))


def without_faulty(run: Run, table: Path) -> Path:
    """The table less the lines that `identify` leaves out."""
    found = identified(HERE / run.cell, table, f"{run.stem}_faulty", "--outliers", "drop")
    faulty = {reading["line"] for reading in found["excluded"]}
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    clean = OUT / f"{run.stem}.csv"
    kept = (line for k, line in enumerate(lines, start=1) if k not in faulty)
    clean.write_text("".join(kept), encoding="utf-8")
    return clean


def mm(micrometres: float) -> str:
    return f"{micrometres / 1e3:.3f}"


def chance(p: float) -> str:
    return f"> {CERTAIN}" if p > CERTAIN else f"{p:.2f}"


def tested(run: Run, data: Path, extended: Path) -> str:
    """Rms error in mm on the test poses without and with what the diagnosis added."""
    if run.test is None:
        return "–"
    options = ("--test", data / run.test)
    before, after = (
        identified(cell, data / run.table, f"{run.stem}_{k}", *options)["test"]["rms_um"]
        for k, cell in (("before", HERE / run.cell), ("after", extended))
    )
    return f"{mm(before)} → {mm(after)}"


def finding_lines(found: dict[str, Any]) -> list[str]:
    lines = []
    for effect in found["effects"]:
        low, high = effect["gap_reduction_ci95"]
        values = [
            f"{p['name']} = {p['value']:.3g} ± {1.96 * p['std']:.1g} {p['unit']}"
            for p in effect["parameters"]
        ]
        values += [f"{key} = {value:.4g}" for key, value in effect["settings"].items()]
        lines.append(
            f"- **{effect['effect']} at {effect['where']}**, probability "
            f"{chance(effect['probability'])}: takes away {100 * effect['gap_reduction']:.0f} % "
            f"({100 * low:.0f} to {100 * high:.0f} %) of the noise-free error of new poses; "
            f"{', '.join(values)}"
        )
    for rivals in found["indistinguishable"]:
        names = " or ".join(f"{r['effect']} at {r['where']}" for r in rivals)
        lines.append(f"- not to be told apart by these data: {names}")
    if found["verdict"] == "unknown_effect":
        place = found["location"]
        lines.append(
            f"- **something without a name** at {place['where']}, stage {place['stage']}, "
            f"probability of the place {chance(place['probability'])}"
        )
    for curve in found["curves"]:
        span = 1e3 * (max(curve["y"]) - min(curve["y"]))
        lines.append(
            f"- its shape: {curve['driver']} moves {curve['entry']} by {span:.2g} "
            f"m{curve['y_unit']} in all"
        )
    return lines or ["- nothing significant"]


def budget_lines(found: dict[str, Any]) -> list[str]:
    lines = ["| step | held-out rms, mm | 95 % |", "|---|---|---|"]
    for step in found["budget"]:
        low, high = step["ci95"]
        span = "" if low == high else f"{mm(low)} to {mm(high)}"
        lines.append(f"| {step['step']} | {mm(step['heldout_rms_um'])} | {span} |")
    return lines


def untold_lines(found: dict[str, Any]) -> list[str]:
    """What the data cannot test, by reason, with the number of places of each effect."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in found["untested"]:
        reasons.setdefault((row["reason"], row["advice"]), []).append(row["effect"])
    lines = []
    for (reason, advice), effects in reasons.items():
        counts = Counter(effects)
        names = ", ".join(f"{name} ({n})" if n > 1 else name for name, n in counts.items())
        lines.append(f"- {reason}: {names}. To do: {advice}.")
    return lines


def section(run: Run, found: dict[str, Any]) -> list[str]:
    best = [
        f"{c['effect']} at {c['where']} ({c['score']:+.0f})" for c in found["candidates"][:SHOWN]
    ]
    noise = found["noise"]
    scatter = ", ".join(f"{1e6 * joint['value']:.0f}" for joint in noise["repeatability"])
    return [
        f"## {run.label}",
        "",
        *finding_lines(found),
        "",
        *budget_lines(found),
        "",
        f"Best named candidates (log evidence): {', '.join(best)}.",
        "",
        f"Noise: reading {mm(noise['reading_sigma_um'])} mm per axis, joints {scatter} µrad; "
        f"{len(noise['faulty'])} of {found['n_readings']} readings left out as faulty.",
        "",
        "What these data cannot tell:",
        "",
        *untold_lines(found),
        *(f"- Warning: {text}." for text in found["warnings"]),
        "",
    ]


def diagnosed(run: Run, data: Path) -> tuple[str, list[str]]:
    """Row of the summary and section of one run, the tables being in the folder `data`."""
    table = without_faulty(run, data / run.table) if run.clean else data / run.table
    result, report, cell = (OUT / f"{run.stem}.{end}" for end in ("json", "html", "toml"))
    begun = time.perf_counter()
    elastocal(
        "diagnose", HERE / run.cell, table, "-o", result, "--report", report, "--cell-out", cell
    )
    seconds = time.perf_counter() - begun
    found = json.loads(result.read_text(encoding="utf-8"))
    gap = [mm(found["gap"][f"{key}_um"]) for key in GAPS]
    row = f"| {run.label} | {found['verdict']} | {' | '.join(gap)} "
    return f"{row}| {tested(run, data, cell)} | {seconds:.0f} |", section(run, found)


def main() -> None:
    data = prepare()
    OUT.mkdir(exist_ok=True)
    rows, sections = [SUMMARY], []
    print(f"\nErrors in mm: held-out 3-D rms, of the length for cables.\n\n{SUMMARY}")
    for run in RUNS:
        row, text = diagnosed(run, data)
        print(row, flush=True)
        rows.append(row)
        sections += text
        whole = "\n".join([*rows, "", *sections]).rstrip() + "\n"
        (HERE / "diagnosis.md").write_text(whole, encoding="utf-8")


if __name__ == "__main__":
    main()
