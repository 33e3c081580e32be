"""The benchmarks run at all, and compare like with like."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
MODULES = ("bench_tools", "bench_arms", "evaluation", "costs", "run", "fits_arm", "fits_elastocal")


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    """The modules by name, as their own scripts import them; forgotten afterwards."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield {name: importlib.import_module(name) for name in MODULES}
    finally:
        sys.path.remove(str(BENCHMARKS))
        for name in MODULES:
            sys.modules.pop(name, None)


def test_a_fit_beside_its_peers_ends_at_the_arm(bench, tmp_path: Path) -> None:
    """At 30 poses of 50 µm, 25 parameters: new poses within 100 µm of where the arm is."""
    arm = bench["fits_arm"]
    given = arm.campaign("mdh", 30, 1)
    arm.write(given, tmp_path)
    clock = bench["bench_tools"].Clock()
    predicted, parameters = bench["fits_elastocal"].fit("plain", tmp_path, clock)
    error = np.linalg.norm(predicted - given.fresh_exact, axis=1)
    assert np.sqrt((error**2).mean()) < 1e-4
    assert parameters >= 25


@pytest.mark.long
@pytest.mark.parametrize("part", ["evaluation", "costs"])
def test_every_part_runs_in_tiny(part: str) -> None:
    command = [sys.executable, str(BENCHMARKS / f"{part}.py"), "--size", "tiny"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "| " in done.stdout and "- " in done.stdout
