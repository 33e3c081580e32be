"""FIGAROH's side of fits_peers.py: one calibration, timed.

    PEERS_PYTHON benchmarks/fits_figaroh.py METHOD FOLDER OUT.npz

METHOD is one of FIGAROH's own ways to choose what is estimated: structural (its default),
excitation, map, map_cv, cv_subset.  Runs in the peers' environment, imports nothing of elastocal.
"""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

from fits_clock import Clock

clock = Clock()
with clock.step("import"):
    import numpy as np
    import yaml
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


def prepared(method: str, folder: Path) -> Ur10:
    robot = load_robot(str(folder / "arm.urdf"))
    joints = [str(name) for name in robot.model.names][1:]
    task: dict[str, Any] = {
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": "universe", "tool_frame": "flange"},
        "parameters": {"calibration_level": "full_params", "estimation": {"method": method}},
        "measurements": {"markers": [{"measurable_dof": [True] * 3 + [False] * 3}]},
        "data": {
            "number_of_samples": len(np.load(folder / "given.npz")["q"]),
            "source_file": str(folder / "readings.csv"),
        },
    }
    config = {
        "robot": {"name": "ur10", "properties": {"joints": {"active_joints": joints}}},
        "tasks": {"calibration": task},
    }
    (folder / f"{method}.yaml").write_text(yaml.safe_dump(config))
    own = Ur10(robot, str(folder / f"{method}.yaml"))
    own.calib_config["known_baseframe"] = own.calib_config["known_tipframe"] = False
    own.load_data_set()
    return own


def main(method: str, folder: Path, out: Path) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        with clock.step("read"):
            own = prepared(method, folder)
        with clock.step("fit"):
            own.create_param_list()
            found = own.solve(enable_logging=False)
    fresh = np.load(folder / "given.npz")["fresh_q"]
    config = dict(own.calib_config, NbSample=len(fresh))
    predicted = calc_updated_fkm(own.model, own.data, found.x, fresh, config).reshape(3, -1).T
    np.savez(
        out, predicted=predicted, parameters=len(found.x), evaluations=found.nfev,
        names=own.calib_config["param_name"], **clock.seconds,
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
