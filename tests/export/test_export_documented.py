"""What docs/exporting.md shows is what happens."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.exports import exported, flanges_in_base, write_result
from support.robots import KR270

PAGE = (Path(__file__).parents[2] / "docs" / "exporting.md").read_text(encoding="utf-8")


def test_the_example_moves_the_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    calibrated, done = exported(*write_result(tmp_path, f'urdf = "{KR270}"'), "mjcf")
    (tmp_path / "calibrated.xml").write_text(done.text)
    monkeypatch.chdir(tmp_path)
    example = re.findall(r"```python\n(.*?)```", PAGE, re.S)[0]
    exec(example, {})
    shown = np.array([float(v) for v in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)])
    q, force = np.array([[0.4, -1.0, 0, 0, 0, 0]]), np.array([0, 0, -2600.0])
    T = flanges_in_base(calibrated, q, force)[0]
    own = [calibrated.values[f"marker:M1.{k}"] for k in "xyz"]
    assert np.abs(shown - (T[:3, :3] @ own + T[:3, 3])).max() < 1e-6
