"""Long runs of the fuzzer: python tests/fuzz/run.py --cases 5000 --seed 100000.

Each case follows from its number, so that `--case N` is that case again, whatever ran before.
Exit code 1 where something broke.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import shutil
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2] / "src"), str(Path(__file__).parents[1])]

from fuzz import campaign, harness, kills  # noqa: E402

BEGIN, END = "<!-- cases: written by tests/fuzz/run.py -->", "<!-- end of cases -->"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="most cases to run")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="longest time")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case")
    parser.add_argument("--verb", action="append", default=[], help="only this verb; repeatable")
    parser.add_argument("--kills", type=int, default=0, help="kill each command so many times")
    parser.add_argument("--harmed", action="append", default=[], help="only this verb; repeatable")
    parser.add_argument("--full", type=int, default=0, help="fill its disk so many times")
    parser.add_argument("--interrupts", type=int, default=0, help="Ctrl-C in each so many times")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the work")
    parser.add_argument("--write", type=Path, help="page whose table this run replaces")
    parser.add_argument("--case", type=int, help="run one case, show it, and keep its folder")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="elastocal-fuzz-"))
    base = folder / "campaign"
    base.mkdir()
    campaign.write(base)
    harness.load_everything()
    if asked.case is not None:
        case = harness.run(harness.make(asked.case, base, folder / "case", tuple(asked.verb)))
        print(f"cd {case.folder}\n{case.told()}\nstdout:\n{case.stdout[-3000:]}")
        return int(bool(case.complaints))
    told, broken = everything(asked, base, folder)
    shutil.rmtree(folder, ignore_errors=True)
    print(told)
    if asked.write is not None:
        page = asked.write.read_text(encoding="utf-8")
        before, rest = page.split(f"{BEGIN}\n")
        _, after = rest.split(END)
        asked.write.write_text(f"{before}{BEGIN}\n\n{told}\n\n{END}{after}", encoding="utf-8")
    return int(broken > 0)


def everything(asked: argparse.Namespace, base: Path, folder: Path) -> tuple[str, int]:
    """Cases and harms, whose findings are printed as they come: the table of how they ended with a
    sentence on the run (Markdown), and how many broke something."""
    begun = time.monotonic()
    until = begun + asked.seconds
    count, broken, done, slowest, largest = Counter[tuple[str, str]](), 0, 0, 0.0, 0
    with ProcessPoolExecutor(asked.jobs, multiprocessing.get_context("fork")) as pool:
        spoilt = partial(one, base, folder, tuple(asked.verb), until)
        for case in pool.map(spoilt, range(asked.seed, asked.seed + asked.cases)):
            if case is None:
                continue
            count[case.command.verb, f"exit {case.code}"] += 1
            done, slowest = done + 1, max(slowest, case.seconds)
            largest = max(largest, case.resident)
            if case.complaints:
                broken += 1
                print(case.told(), flush=True)
        times = dict(zip(kills.HARMS, (asked.kills, asked.full, asked.interrupts), strict=True))
        harm = partial(kills.do_harm, base, folder, asked.seed, times, until)
        verbs = asked.harmed or asked.verb or kills.KILLED
        for found, tried in pool.map(harm, verbs if any(times.values()) else ()):
            print("\n".join(found), end="", flush=True)
            count, broken = count + tried, broken + len(found)
    told = [f"{done} cases from {asked.seed} on"] * bool(done)
    if others := count.total() - done:
        told.append(f"{others} kills, interrupts and full disks (seed {asked.seed})")
    run = f"{', '.join(told)}, with Python {platform.python_version()}: {broken} with a finding; "
    run += f"{time.monotonic() - begun:.0f} s in all."
    if done:
        run += f" Slowest case {slowest:.1f} s of processor time, largest {largest / 1e6:.0f} MB."
    return f"{table(count)}\n\n{run}", broken


def one(
    base: Path, folder: Path, verbs: tuple[str, ...], until: float, seed: int
) -> harness.Case | None:
    if time.monotonic() > until:
        return None
    case = harness.run(harness.make(seed, base, folder / str(seed), verbs))
    shutil.rmtree(folder / str(seed), ignore_errors=True)
    return case


def table(count: Counter[tuple[str, str]]) -> str:
    """One row per verb (Markdown)."""
    columns = ("exit 0", "exit 1", "exit 2", *kills.HARMS)
    rows = ["| verb | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for verb in sorted({verb for verb, _ in count}):
        numbers = (count[verb, column] for column in columns)
        rows.append(f"| `{verb}` | " + " | ".join(str(n or "") for n in numbers) + " |")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(main())
