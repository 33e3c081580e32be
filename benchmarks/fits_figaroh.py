"""FIGAROH's side of fits_peers.py, in the peers' environment; imports nothing of elastocal.

The method is one of FIGAROH's own ways to choose what is estimated: structural (its default),
excitation, map, map_cv, cv_subset.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bench_tools import Clock
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot


class Ur10(BaseCalibration):
    """The subclass that FIGAROH asks for, base and tip frame unknown.

    With positions alone its log-map residual is the plain difference, in this order; computed as
    such it spares FIGAROH a Python loop over poses in every evaluation.
    """

    def cost_function(self, var: Any) -> Any:
        found = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return found - self.PEE_measured


def task_file(
    folder: Path, robot: Any, tool: str, poses: int, data: dict[str, str], **parameters: Any
) -> str:
    """FIGAROH's task of a marker's positions, written to a file of the folder."""
    joints = [str(name) for name in robot.model.names][1:]
    task = {
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": "universe", "tool_frame": tool},
        "parameters": {"calibration_level": "full_params"} | parameters,
        "measurements": {"markers": [{"measurable_dof": [True] * 3 + [False] * 3}]},
        "data": {"number_of_samples": poses} | data,
    }
    properties = {"joints": {"active_joints": joints}}
    config = {"robot": {"name": "ur10", "properties": properties}, "tasks": {"calibration": task}}
    path = folder / "task.yaml"
    path.write_text(yaml.safe_dump(config))
    return str(path)


def prepared(method: str, folder: Path) -> Ur10:
    robot, poses = load_robot(str(folder / "arm.urdf")), len(np.load(folder / "given.npz")["q"])
    data = {"source_file": str(folder / "readings.csv")}
    own = Ur10(
        robot, task_file(folder, robot, "flange", poses, data, estimation={"method": method})
    )
    own.calib_config["known_baseframe"] = own.calib_config["known_tipframe"] = False
    own.load_data_set()
    return own


def fit(method: str, folder: Path, clock: Clock) -> tuple[Any, int]:
    with contextlib.redirect_stdout(io.StringIO()):
        with clock.step("read"):
            own = prepared(method, folder)
        with clock.step("fit"):
            own.create_param_list()
            found = own.solve(enable_logging=False)
    fresh = np.load(folder / "given.npz")["fresh_q"]
    config = dict(own.calib_config, NbSample=len(fresh))
    predicted = calc_updated_fkm(own.model, own.data, found.x, fresh, config)
    return predicted.reshape(3, -1).T, len(found.x)
