"""Long runs of the fuzzer: python tests/fuzz/run.py --cases 5000 --seed 100000.

Each case follows from its number, so that `--case N` is that case again, whatever ran before.
Exit code 1 where something broke.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
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

Done = tuple[str, str]  # exit code or harm, what broke


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="most cases to run")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case")
    parser.add_argument("--verb", action="append", default=[], help="only this verb; repeatable")
    parser.add_argument("--kills", type=int, default=0, help="kill each command so many times")
    parser.add_argument("--full", type=int, default=0, help="fill its disk so many times")
    parser.add_argument("--interrupts", type=int, default=0, help="Ctrl-C in each so many times")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the work")
    parser.add_argument("--case", type=int, help="run one case and show it")
    asked = parser.parse_args()
    folder, begun = Path(tempfile.mkdtemp(prefix="elastocal-fuzz-")), time.monotonic()
    (folder / "campaign").mkdir()
    campaign.write(folder / "campaign")
    harness.load_everything()
    if asked.case is not None:
        asked.seed, asked.cases = asked.case, 1
    times = dict(zip(kills.HARMS, (asked.kills, asked.full, asked.interrupts), strict=True))
    count, broken = Counter[str](), 0
    with ProcessPoolExecutor(asked.jobs, multiprocessing.get_context("fork")) as pool:
        spoilt = partial(case, folder, asked.verb, asked.case is not None)
        harm = partial(harms, folder, asked.seed, times)
        verbs = [v for v in kills.KILLED if not asked.verb or v in asked.verb]
        for work in (pool.map(spoilt, range(asked.seed, asked.seed + asked.cases)),
                     pool.map(harm, verbs if any(times.values()) else ())):  # fmt: skip
            for end, told in (each for found in work for each in found):
                count[end] += 1
                broken += bool(told)
                print(told, end="", flush=True)
    shutil.rmtree(folder)
    ends = ", ".join(f"{end} {n}" for end, n in sorted(count.items()))
    print(f"{ends}; {broken} with a finding; {time.monotonic() - begun:.0f} s in all.")
    return int(broken > 0)


def case(folder: Path, verbs: list[str], show: bool, seed: int) -> list[Done]:
    """The spoilt command of a seed, in a copy of the campaign."""
    rng, place = Random(seed), folder / str(seed)
    work = place / "a" / "b" / "c"  # what `..` names stays within the case
    shutil.copytree(folder / "campaign", work)
    verb = rng.choice(verbs or sorted(campaign.VERBS))
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
    return [(f"exit {ended.code}", told if found or show else "")]


def harms(folder: Path, seed: int, times: dict[str, int], verb: str) -> list[Done]:
    """Do to a verb what `times` says so many times: a few to its first command, many to all."""
    each = sorted((k / many, harm, k) for harm, many in times.items() for k in range(many))
    commands = [c for c in campaign.COMMANDS if c.verb == verb][: 1 + len(each) // 20]
    victims = [kills.Victim(c, folder / "campaign", folder / f"{verb}{i}")
               for i, c in enumerate(commands)]  # fmt: skip
    return [
        (harm, told)
        for i, (_, harm, k) in enumerate(each)
        for told in harmed(victims[i % len(victims)], harm, Random(f"{seed} {verb} {harm} {k}"))
    ]


def harmed(victim: kills.Victim, harm: str, rng: Random) -> Iterator[str]:
    for _ in range(20):  # one that ends before it is killed does not count
        where, found, met = victim.harmed(harm, rng)
        if found or met:
            yield f"--- {victim.command.line}\n    {where}: {'; '.join(found)}\n" if found else ""
            return


if __name__ == "__main__":
    sys.exit(main())
