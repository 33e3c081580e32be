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
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from random import Random

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2] / "src"), str(Path(__file__).parents[1])]

from fuzz import campaign, harness, kills, mutations  # noqa: E402

from elastocal.cli.app import VERBS  # noqa: E402

BEGIN, END = "<!-- cases: written by tests/fuzz/run.py -->", "<!-- end of cases -->"
COLUMNS = ("exit 0", "exit 1", "exit 2", *kills.HARMS)
Done = tuple[str, str, str]  # verb, column of the table, what broke


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
    parser.add_argument("--case", type=int, help="run one case and show it")
    asked = parser.parse_args()
    folder, begun = Path(tempfile.mkdtemp(prefix="elastocal-fuzz-")), time.monotonic()
    (folder / "campaign").mkdir()
    campaign.write(folder / "campaign")
    harness.load_everything()
    if asked.case is not None:
        asked.seed, asked.cases = asked.case, 1
    until = begun + asked.seconds
    times = dict(zip(kills.HARMS, (asked.kills, asked.full, asked.interrupts), strict=True))
    count, broken = Counter[tuple[str, str]](), 0
    with ProcessPoolExecutor(asked.jobs, multiprocessing.get_context("fork")) as pool:
        spoilt = partial(case, folder, asked.verb, until, asked.case is not None)
        harm = partial(harms, folder, asked.seed, times, until)
        verbs = [v for v in kills.KILLED if not asked.verb or v in asked.verb]
        for work in (pool.map(spoilt, range(asked.seed, asked.seed + asked.cases)),
                     pool.map(harm, verbs if any(times.values()) else ())):  # fmt: skip
            for verb, column, told in (each for found in work for each in found):
                count[verb, column] += 1
                broken += bool(told)
                print(told, end="", flush=True)
    shutil.rmtree(folder)
    cases = sum(n for (_, column), n in count.items() if column not in kills.HARMS)
    run = f"{cases} cases from {asked.seed} on, {count.total() - cases} kills, interrupts and full "
    run += f"disks, with Python {platform.python_version()}: {broken} with a finding; "
    run += f"{time.monotonic() - begun:.0f} s in all."
    told = f"{table(count)}\n\n{run}"
    print(told)
    if asked.write is not None:
        before, rest = asked.write.read_text(encoding="utf-8").split(f"{BEGIN}\n")
        page = f"{before}{BEGIN}\n\n{told}\n\n{END}{rest.split(END)[1]}"
        asked.write.write_text(page, encoding="utf-8")
    return int(broken > 0)


def case(folder: Path, verbs: list[str], until: float, show: bool, seed: int) -> list[Done]:
    """The spoilt command of a seed, in a copy of the campaign."""
    if time.monotonic() > until:
        return []
    rng, place = Random(seed), folder / str(seed)
    work = place / "a" / "b" / "c"  # what `..` names stays within the case
    shutil.copytree(folder / "campaign", work)
    verb = rng.choice(verbs or sorted(VERBS))
    command = rng.choice([c for c in campaign.COMMANDS if c.verb == verb])
    words, inputs = command.words, command.inputs(work)
    done = mutations.spoil(rng.choice(inputs), rng) if inputs and rng.random() < 0.75 else ""
    if not done or rng.random() < 0.05:
        words = mutations.spoil_arguments(words, rng)
    if rng.random() < 0.5:
        harness.put_old((name for _, name in command.outputs), work)
    before = harness.seen(work)
    ended = harness.run([verb, *words], work)
    found = "; ".join(harness.complaints(ended, before, work))
    shutil.rmtree(place)
    told = f"--- case {seed}: {found}\n    {done}\n{ended.told()}"
    return [(verb, f"exit {ended.code}", told if found or show else "")]


def harms(folder: Path, seed: int, times: dict[str, int], until: float, verb: str) -> list[Done]:
    """Do to a verb what `times` says so many times: a few to its first command, many to all."""
    each = sorted((k / many, harm, k) for harm, many in times.items() for k in range(many))
    commands = [c for c in campaign.COMMANDS if c.verb == verb][: 1 + len(each) // 20]
    victims = [kills.Victim(c, folder / "campaign", folder / f"{verb}{i}")
               for i, c in enumerate(commands)]  # fmt: skip
    return [
        (verb, harm, told)
        for i, (_, harm, k) in enumerate(each)
        for told in harmed(
            victims[i % len(victims)], harm, Random(f"{seed} {verb} {harm} {k}"), until
        )
    ]


def harmed(victim: kills.Victim, harm: str, rng: Random, until: float) -> Iterator[str]:
    for _ in range(20):  # one that ends before it is killed does not count
        if time.monotonic() > until:
            return
        where, found, met = victim.harmed(harm, rng)
        if found or met:
            yield f"--- {victim.command.line}\n    {where}: {'; '.join(found)}\n" if found else ""
            return


def table(count: Counter[tuple[str, str]]) -> str:
    """One row per verb (Markdown)."""
    rows = ["| verb | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for verb in sorted({verb for verb, _ in count}):
        numbers = (count[verb, column] for column in COLUMNS)
        rows.append(f"| `{verb}` | " + " | ".join(str(n or "") for n in numbers) + " |")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(main())
