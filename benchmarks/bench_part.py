"""What one benchmark hands to run.py: tables, goals, where and when it ran; JSON and Markdown."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
# tiny: does it run at all; short: all of them in ten minutes; full: the largest sizes too.
SIZES = ("tiny", "short", "full")
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass
class Table:
    """Cells are numbers or text; numbers are printed to three digits."""

    title: str
    columns: list[str]
    rows: list[list[Any]] = field(default_factory=list)


@dataclass
class Goal:
    """What issue and README promise, and what was measured; `met` is decided by the benchmark."""

    what: str
    found: str
    met: bool


@dataclass
class Part:
    """One benchmark's results; `curves` are the figure's numbers (label → x and y)."""

    name: str
    title: str
    tables: list[Table] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    curves: dict[str, Any] = field(default_factory=dict)
    where: dict[str, Any] = field(default_factory=dict)

    def goal(self, what: str, found: float, limit: float, unit: str, least: bool = False) -> None:
        """A number that should be at most (`least`: at least) its limit."""
        met = found >= limit if least else found <= limit
        self.goals.append(Goal(what, f"{number(found)} {unit}".strip(), met))


def number(value: Any) -> str:
    """Three digits, no exponent between 0.001 and a million; – for None; text as it is."""
    if value is None:
        return "–"
    if isinstance(value, str | int):
        return str(value)
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}"
    digits = max(0, 2 - int(f"{abs(value):e}".partition("e")[2])) if value else 0
    return f"{value:.{min(digits, 5)}f}"


def markdown(part: Part) -> str:
    """The part as a section of result.md."""
    w = part.where
    lines = [f"## {part.title}", "", ran(w), ""]
    for table in part.tables:
        lines += [f"### {table.title}", "", "| " + " | ".join(table.columns) + " |"]
        lines.append("|" + "---|" * len(table.columns))
        lines += ["| " + " | ".join(number(c) for c in row) + " |" for row in table.rows]
        lines.append("")
    lines += [f"- {g.what}: {g.found}: {'met' if g.met else 'NOT MET'}" for g in part.goals]
    lines += [f"- {remark}" for remark in part.remarks]
    return "\n".join([*lines, ""])


def ran(w: dict[str, Any]) -> str:
    """When, at which commit and on which machine it was measured."""
    return (
        f"{w['date']}, commit {w['commit']}, {w['machine']}; load average {w['load_before']:.1f} "
        f"before and {w['load_after']:.1f} after; {w['size']} sizes, {w['seconds']:.0f} s."
    )


def commit() -> str:
    """The commit that is checked out, with + where files differ from it; – outside git."""
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=HERE, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "–"
    return done.stdout.strip()


def machine() -> str:
    """Processor, cores, system and Python, as the tables' footnote."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [x for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        name = models[0].partition(":")[2].strip() if models else name
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores, {platform.system()}, Python {platform.python_version()}"


def run_alone(measure: Callable[[str], Part]) -> None:
    """The command line of one benchmark: `[--size SIZE] [--json FILE]`; prints its section."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--size", choices=SIZES, default="short", help="what it may take")
    parser.add_argument("--json", type=Path, help="write the result there")
    chosen = parser.parse_args()
    start, load = time.perf_counter(), os.getloadavg()[0]
    part = measure(chosen.size)
    part.where = {
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "commit": commit(),
        "machine": machine(),
        "load_before": load,
        "load_after": os.getloadavg()[0],
        "seconds": time.perf_counter() - start,
        "size": chosen.size,
    }
    print(markdown(part), flush=True)
    if chosen.json:
        temporary = chosen.json.with_suffix(".tmp")
        temporary.write_text(json.dumps(asdict(part), indent=1))
        os.replace(temporary, chosen.json)


def read_part(path: Path) -> Part:
    """What `run_alone` wrote."""
    content = json.loads(path.read_text())
    content["tables"] = [Table(**t) for t in content["tables"]]
    content["goals"] = [Goal(**g) for g in content["goals"]]
    return Part(**content)
