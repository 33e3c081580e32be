"""The blind check of `elastocal diagnose`.

    elastocal study experiment_design/blind_diagnosis --seed S [--set catalogue300=0 …]

Draws worlds, seals their truth, has each diagnosed by a process that is not given it, and only
then scores.  An option per suite says how many worlds of each effect it draws; 0 leaves it out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from one_world import diagnose_world
from suites import SUITES, named
from suites import tasks as suite_tasks
from table import records_of, report


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for suite in SUITES:
        per_effect = options[suite.partition("-")[0]]
        # Names follow from effect and number; the seed comes with `rng`.  The first world of every
        # effect before the second of any: what is done when it stops is of all effects.
        names = (task.recipe.name for task in suite_tasks(suite, 0, per_effect))
        for name in sorted(names, key=lambda name: name.rpartition("-")[2]):
            yield {"suite": suite, "world": name}


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The world's record as JSON.  A world follows from the study's seed, its suite and its name,
    so that a part of the study draws the same worlds as the whole."""
    seed = int(rng.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]
    record = diagnose_world(named(task["suite"], seed, task["world"]), {"seed": seed})
    answer = record["answer"]
    return {
        "verdict": None if answer is None else answer["verdict"],
        "seconds": record["seconds"],
        "record": json.dumps(record),
    }


def summary(frame: pd.DataFrame) -> str:
    return report(records_of(frame))
