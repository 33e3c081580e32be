"""Long runs of the fuzzer: python tests/fuzz/run.py --cases 5000 --seed 100000.

Each case follows from its number, so that `--case N` is that case again, whatever ran before.
Exit code 1 where something broke.
"""

from __future__ import annotations

import argparse
import os
import pickle
import platform
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
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
    parser.add_argument("--full", type=int, default=0, help="fill its disk so many times")
    parser.add_argument("--interrupts", type=int, default=0, help="Ctrl-C in each so many times")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the work")
    parser.add_argument("--write", type=Path, help="page whose table this run replaces")
    parser.add_argument("--record", type=Path, help="keep what was tried in this file")
    parser.add_argument(
        "--add", type=Path, action="append", default=[], help="add such a file; repeatable"
    )
    parser.add_argument("--case", type=int, help="run one case, show it, and keep its folder")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="elastocal-fuzz-"))
    base = folder / "campaign"
    base.mkdir()
    anything = asked.cases or asked.kills or asked.full or asked.interrupts
    if anything or asked.case is not None:
        campaign.write(base)
        harness.load_everything()
    if asked.case is not None:
        case = harness.run(harness.make(asked.case, base, folder / "case", tuple(asked.verb)))
        print(f"cd {case.folder}\n{case.told()}\nstdout:\n{case.stdout[-3000:]}")
        return int(bool(case.complaints))
    begun = time.monotonic()
    parts = {fork(asked, base, folder, k): k for k in range(asked.jobs if anything else 0)}
    tally = Tally()
    while parts:
        child, status = os.wait()
        part = parts.pop(child, None)
        if part is not None and status:
            raise RuntimeError(f"part {part} of {asked.jobs} ended with {status}")
        if part is not None:
            tally.add(pickle.loads((folder / f"part{part}").read_bytes()))
    shutil.rmtree(folder, ignore_errors=True)
    if tally.count:
        tally.close(asked.seed, time.monotonic() - begun)
    if asked.record is not None:
        asked.record.write_bytes(pickle.dumps(tally))
    for path in asked.add:
        tally.add(pickle.loads(path.read_bytes()))
    told = "\n\n".join((tally.table(), *tally.runs))
    print(told)
    if asked.write is not None:
        page = asked.write.read_text(encoding="utf-8")
        before, rest = page.split(f"{BEGIN}\n")
        _, after = rest.split(END)
        asked.write.write_text(f"{before}{BEGIN}\n\n{told}\n\n{END}{after}", encoding="utf-8")
    return int(bool(tally.broken))


def fork(asked: argparse.Namespace, base: Path, folder: Path, part: int) -> int:
    """A process that runs every `jobs`-th case and kill, and leaves its tally in `folder`."""
    sys.stdout.flush()
    if child := os.fork():
        return child
    status = 1
    try:
        tally, until = Tally(), time.monotonic() + asked.seconds
        for seed in range(asked.seed, asked.seed + asked.cases)[part :: asked.jobs]:
            if time.monotonic() > until:
                break
            tally.take(harness.run(harness.make(seed, base, folder / str(seed), tuple(asked.verb))))
            shutil.rmtree(folder / str(seed), ignore_errors=True)
        times = {
            "killed": asked.kills, "disk full": asked.full, "interrupted": asked.interrupts,
        }  # fmt: skip
        if any(times.values()):
            own, share = folder / f"kills{part}", slice(part, None, asked.jobs)
            verbs = asked.verb or kills.KILLED
            found, tried = kills.run_kills(base, own, asked.seed, times, verbs, share, until)
            tally.count.update(tried)
            tally.broken += found
        (folder / f"part{part}").write_bytes(pickle.dumps(tally))
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)


class Tally:
    """What was tried and how it ended."""

    def __init__(self) -> None:
        self.count: Counter[tuple[str, str]] = Counter()
        self.broken, self.slowest, self.largest = 0, 0.0, 0
        self.runs: list[str] = []

    def take(self, case: harness.Case) -> None:
        self.count[case.command.verb, f"exit {case.code}"] += 1
        self.slowest = max(self.slowest, case.seconds)
        self.largest = max(self.largest, case.resident)
        if case.complaints:
            self.broken += 1
            print(case.told(), flush=True)

    def add(self, other: Tally) -> None:
        """What another process or run has tried."""
        self.count += other.count
        self.runs += other.runs
        self.broken += other.broken
        self.slowest = max(self.slowest, other.slowest)
        self.largest = max(self.largest, other.largest)

    def table(self) -> str:
        """One row per verb (Markdown)."""
        columns = ("exit 0", "exit 1", "exit 2", *kills.HARMS)
        rows = ["| verb | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        for verb in sorted({verb for verb, _ in self.count}):
            numbers = (self.count[verb, column] for column in columns)
            rows.append(f"| `{verb}` | " + " | ".join(str(n or "") for n in numbers) + " |")
        return "\n".join(rows)

    def close(self, seed: int, seconds: float) -> None:
        """Say what this run was."""
        cases = sum(n for (_, how), n in self.count.items() if how.startswith("exit"))
        others = self.count.total() - cases
        told = [f"{cases} cases from {seed} on"] * bool(cases)
        told += [f"{others} kills, interrupts and full disks (seed {seed})"] * bool(others)
        found = f"{', '.join(told)}, with Python {platform.python_version()}: {self.broken} with a "
        found += f"finding; {seconds:.0f} s in all."
        if cases:
            found += f" Slowest case {self.slowest:.1f} s of processor time, "
            found += f"largest {self.largest / 1e6:.0f} MB."
        self.runs.append(found)


if __name__ == "__main__":
    sys.exit(main())
