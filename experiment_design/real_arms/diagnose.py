"""Diagnose the real arms of the public data sets, by elastocal's own command line.

ELASTOCAL_DATASETS=… python diagnose.py          writes diagnosis.md, out/diagnosis_*
ELASTOCAL_DATASETS=… python diagnose.py ur5 wam  runs these again, keeps the others
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prepare import HERE, prepare

OUT = HERE / "out"
CERTAIN = 0.995


@dataclass(frozen=True)
class Run:
    """`table` is diagnosed, and the cell identified before and after; where there is a `test`
    table, both predict its poses.  `clean` leaves out the readings that `identify` does.

    `published`: the mean error in mm that others reached on the same test poses.
    """

    key: str
    label: str
    cell: str
    table: str
    test: str | None = None
    published: float | None = None
    clean: bool = False

    @property
    def stem(self) -> str:
        return f"diagnosis_{self.key}"


RUNS = (
    Run("ur10_100", "UR10, 100 poses", "ur10.toml", "ur10_100.csv", "ur10_test.csv"),
    Run("ur10_600", "UR10, 600 poses", "ur10.toml", "ur10_600.csv", "ur10_test.csv"),
    Run("ur10_3000", "UR10, 3000 poses", "ur10.toml", "ur10_3000.csv", "ur10_test.csv"),
    Run(
        "ur10_blocks", "UR10, 6 blocks of 100 poses", "ur10.toml", "ur10_blocks_600.csv",
        "ur10_blocks_test.csv",
    ),
    Run(
        "ur10_first", "UR10, the first 600 poses", "ur10.toml", "ur10_first_600.csv",
        "ur10_first_test.csv",
    ),
    Run("ur5", "UR5, 1000 poses", "ur5.toml", "ur5_grid.csv", "ur5_random.csv", 0.155),
    Run("wam", "WAM, 216 poses", "wam.toml", "wam_grid.csv", "wam_random.csv", 2.918),
    Run("iiwa7", "iiwa 7, rigid", "iiwa7_rigid.toml", "iiwa7.csv"),
    Run("iiwa7_scale", "iiwa 7, rigid, encoder scales", "iiwa7_rigid_scale.toml", "iiwa7.csv"),
    Run(
        "iiwa7_part", "iiwa 7, rigid, four fifths", "iiwa7_rigid.toml", "iiwa7_train.csv",
        "iiwa7_test.csv",
    ),
    Run("irb120", "IRB 120 by cable, as is", "irb120.toml", "irb120.csv"),
    Run(
        "irb120_clean", "IRB 120 by cable, faulty left out", "irb120.toml", "irb120.csv",
        clean=True,
    ),
)  # fmt: skip
SUMMARY = (
    "| run | verdict | error, mm | nominal | geometry | as diagnosed "
    "| mean of it (published) | noise floor | s | CPU s | MB |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)


def elastocal(*arguments: object) -> dict[str, float]:
    """Run the command line: its seconds, those of CPU, its peak of resident memory in MB.

    Raises CalledProcessError where it fails.
    """
    command = [sys.executable, "-m", "elastocal", *map(str, arguments), "--quiet"]
    begun = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)
    cpu, peak = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    return {"seconds": time.perf_counter() - begun, "cpu": cpu, "peak": peak}


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def identified(cell: Path, table: Path, name: str, *options: object) -> dict[str, Any]:
    result = OUT / f"{name}.json"
    elastocal("identify", cell, table, "-o", result, *options)
    return read(result)


def without_faulty(run: Run, table: Path) -> Path:
    """The table less the lines that `identify` leaves out."""
    found = identified(HERE / run.cell, table, f"{run.stem}_faulty", "--outliers", "drop")
    faulty = {reading["line"] for reading in found["excluded"]}
    lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
    clean = OUT / f"{run.stem}.csv"
    kept = (line for k, line in enumerate(lines, start=1) if k not in faulty)
    clean.write_text("".join(kept), encoding="utf-8")
    return clean


def mm(micrometres: float | None) -> str:
    return "–" if micrometres is None else f"{micrometres / 1e3:.3f}"


def chance(p: float) -> str:
    return f"> {CERTAIN}" if p > CERTAIN else f"{p:.2f}"


def percent(share: float) -> str:
    return f"{100 * share:.{1 if abs(share) < 0.095 else 0}f}"


def between(low: float, high: float) -> str:
    return f"{percent(low)} to {percent(high)}"


def causes(found: dict[str, Any]) -> Iterator[str]:
    """What is said to be there: of one or two causes each, of many each error at its place."""
    if not found["components"]:
        for e in found["effects"]:
            yield (
                f"- **{e['effect']} at {e['where']}**, probability {chance(e['probability'])}: "
                f"takes away {between(*e['gap_reduction_ci95'])} % of the error of new poses"
            )
        if not found["effects"]:
            yield f"- {found['verdict']}"
        return
    yield "| depends on | place | effects | share of the gap, % | 90 % | rms, mm | there |"
    yield "|---|---|---|---|---|---|---|"
    for c in found["components"]:
        values = (
            c["family"], c["where"], ", ".join(c["effects"]), percent(c["share"]),
            between(*c["share_ci90"]), mm(c["rms_um"]), chance(c["probability"]),
        )  # fmt: skip
        yield f"| {' | '.join(values)} |"


def budget(found: dict[str, Any]) -> Iterator[str]:
    yield "| step | held-out rms, mm | 95 % |"
    yield "|---|---|---|"
    for step in found["budget"]:
        low, high = step["ci95"]
        span = "" if low == high else f"{mm(low)} to {mm(high)}"
        yield f"| {step['step']} | {mm(step['heldout_rms_um'])} | {span} |"


def errors(found: dict[str, Any]) -> float:
    """Rms error in µm of the poses never fitted, else of those predicted from the others."""
    return (found["test"] or {}).get("rms_um") or found["heldout_rms_um"]


def diagnose(run: Run, data: Path) -> None:
    """Diagnose, identify before and after, and keep what the table needs in `out`."""
    table = without_faulty(run, data / run.table) if run.clean else data / run.table
    result, report, cell = (OUT / f"{run.stem}.{end}" for end in ("json", "html", "toml"))
    cost = elastocal(
        "diagnose", HERE / run.cell, table, "-o", result, "--report", report, "--cell-out", cell
    )
    options = ("--test", data / run.test) if run.test else ()
    before = identified(HERE / run.cell, table, f"{run.stem}_before", *options)
    after = identified(cell, table, f"{run.stem}_after", *options)
    measured = cost | {"before": errors(before), "after": errors(after)}
    measured["nominal"] = before["nominal_rms_um"]
    measured["dropped"] = [len(fit["excluded"]) for fit in (before, after)]
    (OUT / f"{run.stem}_measured.json").write_text(json.dumps(measured), encoding="utf-8")


def row(run: Run, found: dict[str, Any], measured: dict[str, Any]) -> str:
    fitted = read(OUT / f"{run.stem}_after.json")["test"]
    mean = mm((fitted or {}).get("mean_um"))
    mean += f" ({run.published:.3f})" if run.published else ""
    values = (
        run.label, found["verdict"], "test" if run.test else "held out", mm(measured["nominal"]),
        mm(measured["before"]), mm(measured["after"]), mean,
        mm(found["gap"]["noise_floor_um"]),
        f"{measured['seconds']:.0f}", f"{measured['cpu']:.0f}", f"{measured['peak']:.0f}",
    )  # fmt: skip
    return f"| {' | '.join(values)} |"


def write_summary(runs: tuple[Run, ...]) -> None:
    rows, sections = [SUMMARY], []
    for run in runs:
        if (kept := OUT / f"{run.stem}_measured.json").is_file():
            found = read(OUT / f"{run.stem}.json")
            rows.append(row(run, found, read(kept)))
            sections += [f"## {run.label}", "", *causes(found), "", *budget(found), ""]
    whole = "\n".join([*rows, "", *sections]).rstrip() + "\n"
    (HERE / "diagnosis.md").write_text(whole, encoding="utf-8")


def main(chosen: list[str]) -> None:
    keys = [run.key for run in RUNS]
    if unknown := sorted({*chosen} - {*keys}):
        sys.exit(f"no such run: {', '.join(unknown)}; there are {', '.join(keys)}")
    data = prepare()
    OUT.mkdir(exist_ok=True)
    print(f"\nErrors in mm: 3-D rms, of the length for cables.\n\n{SUMMARY}")
    for run in RUNS:
        if not chosen or run.key in chosen:
            diagnose(run, data)
            found = read(OUT / f"{run.stem}.json")
            print(row(run, found, read(OUT / f"{run.stem}_measured.json")), flush=True)
            write_summary(RUNS)


if __name__ == "__main__":
    main(sys.argv[1:])
