"""FIGAROH's side of design_peers.py: its regressor of a pool, its SOCP, its DetMax, timed.

    OPENBLAS_NUM_THREADS=1 PEERS_PYTHON benchmarks/figaroh_pool.py UR10.urdf POOL.npz OUT.npz

Runs in the peers' environment and imports nothing of elastocal.  POOL.npz: `q` (N, 6) rad,
`poses`, `seed`.  OUT.npz: `regressor` (N, 3, p), `names`, `weights` (N,), `ranked` (chosen,), the
set that FIGAROH chooses in its order, `detmax` the log det that its DetMax ends at (it forgets the
set), `status` of the solver, and wall seconds and CPU seconds of each step: regressor, socp (model
and solve), solver (cvxopt alone, wall only), detmax.
"""

from __future__ import annotations

import random
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bench_tools import Clock
from figaroh.calibration.calibration_tools import (
    calculate_base_kinematics_regressor,
    measurement_jacobian,
    select_identifiable_parameters,
)
from figaroh.calibration.parameter import add_base_name, add_pee_name
from figaroh.optimal.base_optimal_calibration import BaseOptimalCalibration, Detmax, SOCPOptimizer
from figaroh.tools.load_robot import load_robot
from fits_figaroh import task_file

MARKER_M = "0.1 0.05 0.1"  # off the last axis, so that the marker sees all that a position can


class UnknownFrames(BaseOptimalCalibration):
    """FIGAROH's design for what its calibration estimates with base and tip frame unknown.

    Its own regressor leaves both out and would count 26 parameters; BaseCalibration adds them and
    then drops what they absorb, by the same functions as here.
    """

    def calculate_regressor(self) -> bool:
        if hasattr(self, "R_rearr"):
            return True
        config = self.calib_config
        config["known_baseframe"] = config["known_tipframe"] = False
        calculate_base_kinematics_regressor(
            self.q_measured, self.model, self.data, config, tol_qr=1e-6
        )
        add_base_name(config)
        add_pee_name(config)
        names = list(config["param_name"])
        frames = [name for name in names if name.startswith(("base", "pEE"))]
        J = measurement_jacobian(
            self.model, self.data, np.zeros(len(names)), self.q_measured, config
        )
        kept, _ = select_identifiable_parameters(J, names, frames)
        config["param_name"] = kept
        J = J[:, [names.index(name) for name in kept]]
        self.R_rearr = self.rearrange_rb(J, config)
        self._subX_list, self._subX_dict = self.sub_info_matrix(self.R_rearr, config)
        return True


def prepared(urdf: Path, q: np.ndarray, folder: Path) -> UnknownFrames:
    """The UR10 without meshes and with a marker, the pool as FIGAROH reads it."""
    tree = ElementTree.parse(urdf)
    robot = tree.getroot()
    for link in robot.iter("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    ElementTree.SubElement(robot, "link", name="marker")
    joint = ElementTree.SubElement(robot, "joint", name="marker_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link="tool0")
    ElementTree.SubElement(joint, "child", link="marker")
    ElementTree.SubElement(joint, "origin", xyz=MARKER_M)
    tree.write(folder / "robot.urdf")
    loaded = load_robot(str(folder / "robot.urdf"))
    names = [str(name) for name in loaded.model.names][1:]
    pool = {"calibration_joint_names": names, "calibration_joint_configurations": q.tolist()}
    (folder / "pool.yaml").write_text(yaml.safe_dump(pool))
    data = {"sample_configurations_file": str(folder / "pool.yaml")}
    return UnknownFrames(loaded, task_file(folder, loaded, "marker", len(q), data))


def main(urdf: Path, pool: Path, out: Path) -> None:
    given, clock = np.load(pool), Clock()
    q = given["q"]
    with tempfile.TemporaryDirectory() as folder:
        design = prepared(urdf, q, Path(folder))
        with clock.step("regressor"):
            design.load_candidate_configurations()
            design.calculate_regressor()
    with clock.step("socp"):
        socp = SOCPOptimizer(design._subX_dict, design.calib_config)
        weights, design.w_dict_sort = socp.solve()
    random.seed(int(given["seed"]))
    with clock.step("detmax"):
        history = Detmax(design._subX_dict, int(given["poses"])).main_algo()
    p = design.R_rearr.shape[1]
    found: dict[str, Any] = {
        "regressor": design.R_rearr.reshape(len(q), 3, p),
        "names": design.calib_config["param_name"],
        "weights": weights,
        "ranked": design._select_by_threshold(),
        "detmax": p * np.log(history[-1]),
        "status": str(socp.solution.status),
        "wall_solver": socp.solution.searchTime,
    }
    np.savez(out, **found, **clock.seconds)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
