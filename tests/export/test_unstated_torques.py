"""What follows recorded torques has no cost where nobody states them, and is left out."""

from __future__ import annotations

from pathlib import Path

from support.exports import write_result
from support.robots import KR270

import elastocal as ec
from elastocal.export.exportable import keep
from elastocal.model.calibrated import Conditions


def test_an_arm_with_torque_couplings_is_exported_without_them(tmp_path: Path) -> None:
    effects = ["base_frame", "joint_offset:joint2", "torque_coupling:joint2", "move_lag:joint3"]
    arm = ec.read_calibrated(*write_result(tmp_path, f'urdf = "{KR270}"', effects))
    omitted = {o.effect: o.note for o in keep(arm, False, Conditions()).omissions}
    assert "recorded torques" in omitted["torque_coupling"]
    arm.save(tmp_path / "arm.urdf")
