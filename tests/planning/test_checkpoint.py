"""A design's state on disk survives an interrupt, and never serves another design."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from elastocal.planning import Checkpoint, Stage, key_of


def test_a_stage_gives_back_what_it_was_given(tmp_path: Path) -> None:
    state = {"q": np.arange(6.0).reshape(2, 3), "done": np.array([True, False]), "n": np.int64(4)}
    checkpoint = Checkpoint.beside(tmp_path / "plan.csv", "ab" * 32)
    assert not checkpoint.begun
    checkpoint.stage("pool").save(state)
    again = Checkpoint.beside(tmp_path / "plan.csv", "ab" * 32)
    assert again.begun
    loaded = again.stage("pool").load()
    assert loaded is not None and loaded.keys() == state.keys()
    assert all(np.array_equal(loaded[k], state[k]) for k in state)
    assert again.stage("other").load() is None
    again.clear()
    assert list(tmp_path.iterdir()) == []


def test_another_input_starts_anew(tmp_path: Path) -> None:
    Checkpoint.beside(tmp_path / "plan.csv", "1" * 64).stage("pool").save({"q": np.zeros(3)})
    assert not Checkpoint.beside(tmp_path / "plan.csv", "2" * 64).begun


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"something else"])
def test_a_spoilt_file_counts_as_nothing_done(tmp_path: Path, content: bytes) -> None:
    stage = Stage(tmp_path / "pool.npz")
    stage.save({"q": np.zeros(3)})
    (tmp_path / "pool.npz").write_bytes(content)
    assert stage.load() is None


def test_the_key_changes_with_every_input(tmp_path: Path) -> None:
    cell, urdf = tmp_path / "cell.toml", tmp_path / "arm.urdf"
    cell.write_text("a")
    urdf.write_text("b")
    first = key_of([cell, urdf], seed=1)
    assert first == key_of([cell, urdf], seed=1)
    assert first != key_of([cell, urdf], seed=2)
    urdf.write_text("c")
    assert first != key_of([cell, urdf], seed=1)
