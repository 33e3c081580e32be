"""The blind check of `elastocal diagnose`.

    python run.py --seed S [--per-effect 30] [--jobs 2] [--out DIR] [--only SUITE …]

Draws worlds, seals their truth, has each diagnosed by a process that is not given it, and only
then scores.  A line is written as each world is done: stop and start as you like.  Writes result.md
and reliability.png to DIR (default runs/seed-S).
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from result_tables import write_report
from rich.progress import Progress
from suite_run import HERE, run_suite
from suites import SUITES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--per-effect", type=int, default=30)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", nargs="+", choices=tuple(SUITES), default=tuple(SUITES))
    chosen = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # a process per core has no use for more
    out = chosen.out or HERE / "runs" / f"seed-{chosen.seed}"
    out.mkdir(parents=True, exist_ok=True)
    with Progress() as bar:
        for suite in chosen.only:
            run_suite(suite, chosen.seed, chosen.per_effect, chosen.jobs, out, bar)
    print(write_report(out))


if __name__ == "__main__":
    main()
