"""What follows recorded torques has no cost where nobody states them, and is left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.cells import COMPLIANCE, kr270_cell, random_table

import elastocal as ec
from elastocal.cell.arm_description import Nominal
from elastocal.export.exportable import keep
from elastocal.model.calibrated import Conditions


def test_an_arm_with_torque_couplings_is_exported_without_them(tmp_path: Path) -> None:
    effects = ["base_frame", "joint_offset:joint2", "torque_coupling:joint2", "move_lag:joint3"]
    model = ec.Model(kr270_cell(effects, nominal=Nominal(COMPLIANCE)))
    table = random_table(model.chain, 12, 3)
    read = model.predict(table, model.nominal).reshape(-1, 3)
    noise = 1e-5 * np.random.default_rng(0).normal(size=read.shape)
    fit = ec.identify(model, replace(table, position=read + noise))
    omitted = {o.effect: o.note for o in keep(fit.arm, False, Conditions()).omissions}
    assert "recorded torques" in omitted["torque_coupling"]
    fit.arm.save(tmp_path / "arm.urdf")
