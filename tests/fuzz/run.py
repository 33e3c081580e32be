"""Long runs of the fuzzer: python tests/fuzz/run.py --cases 5000 --seed 100000.

Each case follows from its number, so that `--case N` is that case again, whatever ran before.
Exit code 1 where something broke.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2] / "src"), str(Path(__file__).parents[1])]

from fuzz import campaign, harness, kills  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="most cases to run")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="longest time")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case")
    parser.add_argument("--verb", action="append", default=[], help="only this verb; repeatable")
    parser.add_argument("--kills", type=int, default=0, help="kill each command so many times")
    parser.add_argument("--full", type=int, default=0, help="fill its disk so many times")
    parser.add_argument("--case", type=int, help="run one case, show it, and keep its folder")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="elastocal-fuzz-"))
    os.environ.setdefault("ELASTOCAL_CACHE", str(folder / "cache"))
    base = folder / "campaign"
    base.mkdir()
    campaign.write(base)
    harness.load_everything()
    if asked.case is not None:
        case = harness.run(harness.make(asked.case, base, folder / "case", tuple(asked.verb)))
        print(f"cd {case.folder}\n{case.told()}\nstdout:\n{case.stdout[-3000:]}")
        return int(bool(case.complaints))
    ends: Counter[tuple[str, int]] = Counter()
    broken, slowest, largest, begun = 0, 0.0, 0, time.monotonic()
    for seed in range(asked.seed, asked.seed + asked.cases):
        if time.monotonic() - begun > asked.seconds:
            break
        case = harness.run(harness.make(seed, base, folder / str(seed), tuple(asked.verb)))
        shutil.rmtree(folder / str(seed), ignore_errors=True)
        ends[case.command.verb, case.code] += 1
        slowest, largest = max(slowest, case.seconds), max(largest, case.resident)
        if case.complaints:
            broken += 1
            print(case.told(), flush=True)
    if asked.kills or asked.full:
        found, tried = kills.run_kills(base, folder, asked.seed, asked.kills, asked.full)
        broken += found
        for (verb, how), n in tried.items():
            print(f"{verb:12} {how}: {n}")
    shutil.rmtree(folder, ignore_errors=True)
    for (verb, code), n in sorted(ends.items()):
        print(f"{verb:12} exit {code}: {n}")
    print(
        f"{sum(ends.values())} cases, {broken} with a finding; slowest {slowest:.1f} s of "
        f"processor, largest {largest / 1e6:.0f} MB; {time.monotonic() - begun:.0f} s in all"
    )
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
