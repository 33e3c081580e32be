"""The next poses from what was measured so far, and when no more are needed."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.design_commands import elastocal

from elastocal.demo.example import run_demo
from elastocal.diagnosis.next_poses import verdict_of
from elastocal.planning.plan import Gain

INPUTS = Path(__file__).parents[1] / "golden" / "inputs" / "campaign"
FEW = ["--candidates", "60", "-q"]


def test_measuring_ends_where_enough_is_kept_or_nothing_is_won() -> None:
    inf = float("inf")
    won, lost, first = Gain(3, 2, 1, 1, 6), Gain(3, 2.99, 1, 1, 6), Gain(inf, inf, inf, 1, inf)
    assert verdict_of(won, 6, None, 0.01) == verdict_of(won, 6, 5, 0.01) == "measure"
    assert verdict_of(won, 5, 5, 0.01) == verdict_of(lost, 5, 5, 0.01) == "enough"
    assert (
        verdict_of(lost, 6, 5, 0.01) == "no_gain" and verdict_of(first, inf, 5, 0.01) == "measure"
    )


@pytest.mark.long
def test_enough_is_said_and_no_plan_is_written(tmp_path) -> None:
    run_demo(tmp_path)
    path = tmp_path / "none.csv"
    words = ("next", tmp_path / "cell.toml", tmp_path / "data.csv", "-o", path)
    done = elastocal(*words, "--require", "new_poses=1000", *FEW)
    told = " ".join(done.output.split())
    assert done.exit_code == 0 and not path.exists() and "not written" in told
    assert "no further pose is needed: the required error is kept with 95 %" in told
    assert "(required: 1e+03 µm)" in told


@pytest.mark.parametrize("limit", ["heldout=50", "new_poses=0", "50"])
def test_another_limit_is_refused(tmp_path, limit) -> None:
    words = ("next", INPUTS / "wished.toml", INPUTS / "data.csv", "-o", tmp_path / "n.csv")
    done = elastocal(*words, "--require", limit)
    assert done.exit_code == 2 and "NAME one of new_poses" in " ".join(done.output.split())
