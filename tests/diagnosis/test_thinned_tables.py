"""Of a large table a part is looked at, from its first hour to its last, and that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.diagnosis_data import campaign

from elastocal.diagnosis.baseline import MOST_CONFIGURATIONS, MOST_ROWS, thinned
from elastocal.measurements import Measurements, with_moves


def repeated(times: int, poses: int = 40) -> Measurements:
    """The campaign of 40 poses over and over, as `times` · 40 configurations."""
    table = campaign("encoder_scale:joint3")[1]
    table = table.take(table.configuration < poses)
    every = table.take(np.tile(np.arange(len(table)), times))
    lap = np.repeat(np.arange(times), len(table))
    labels = tuple(str(k) for k in range(times * poses))
    return replace(
        every, configuration=every.configuration + poses * lap, configuration_labels=labels,
        row=np.arange(len(every)) + 2, time=every.time + (table.time.max() + 30.0) * lap,
    )  # fmt: skip


def test_configurations_stay_whole_and_evenly_spaced() -> None:
    table = repeated(100)
    kept, said = thinned(table)
    assert 0.9 * MOST_ROWS < len(kept) <= MOST_ROWS
    assert f"{len(kept)} of {len(table)} rows" in said
    assert (np.bincount(kept.configuration)[np.unique(kept.configuration)] == 6).all()
    times = np.unique(kept.time)
    assert np.ptp(times) > 0.99 * np.ptp(table.time)
    assert np.diff(times).max() < 10 * np.ptp(table.time) / len(times)


def test_of_many_poses_a_part_is_enough_and_keeps_its_moves() -> None:
    table = repeated(100)
    single = with_moves(table.take(np.unique(table.configuration, return_index=True)[1]))
    kept, said = thinned(single)
    assert len(kept) == MOST_CONFIGURATIONS < len(single) < MOST_ROWS
    assert said is not None
    assert kept.move is not None and single.move is not None
    moves = dict(zip(single.row, single.move, strict=True))
    assert all((moves[row] == own).all() for row, own in zip(kept.row, kept.move, strict=True))
