"""Does a compensated command put a real tool where it should be?  Asked of an arm in MuJoCo.

    python experiment_design/compensation/study.py [--arms 8] [--targets 500] [--jobs 2]

A KR 270-2 under 2.6 kN and an iiwa 14 under 140 N, each with random geometric errors and
compliances, are measured with a tracker (simulated in MuJoCo), identified by `elastocal identify`,
and commanded to targets in the tracker's frame by `elastocal compensate`, under the load.  MuJoCo
says where the tool really goes.  Writes result.md.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import numpy as np
from elastic_arm import MujocoArm
from joblib import Parallel, delayed
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from elastocal.cell.work_cell import Cell, read_cell
from elastocal.compensation.compensate import compensate
from elastocal.compensation.targets import read_targets
from elastocal.measurements import Measurements, write_measurements
from elastocal.model.calibrated import read_calibrated
from elastocal.model.calibrated_tool import tool_point
from elastocal.model.chain import Chain, joint_limits
from elastocal.model.choice import load_chain
from elastocal.model.rigid import nominal_flanges
from elastocal.simulation.simulate import expand_plan

HERE = Path(__file__).resolve().parent
NOISE = 20e-6  # m per axis
LENGTH, ANGLE = 0.5e-3, 0.5e-3  # geometric errors per link, m and rad
POSES = 60
SMALLEST = 0.05  # singular value of the flange's Jacobian (m and rad) of poses and targets
KR270 = "KR 270-2, 2.6 kN"
IIWA = "iiwa 14, 140 N"
FORCE = {KR270: 2600.0, IIWA: 140.0}
COMPLIANCE = {  # rad/(N m); Table 3 of Klimchik et al. (2013), and typical of strain-wave gears
    KR270: (3.5e-7, 2.87e-7, 4.16e-7, 2.786e-6, 3.483e-6, 2.074e-6),
    IIWA: (3e-5, 3e-5, 4e-5, 4e-5, 8e-5, 1e-4, 1e-4),
}
MARKERS = {"M1": (0.20, 0.0, 0.25), "M2": (-0.15, 0.20, 0.10), "M3": (-0.10, -0.25, 0.15)}
SHORT = {name: tuple(0.4 * c for c in place) for name, place in MARKERS.items()}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--arms", type=int, default=8)
    options.add_argument("--targets", type=int, default=500)
    options.add_argument("--jobs", type=int, default=2)
    given = options.parse_args()
    cases = [(name, seed) for seed in range(given.arms) for name in (KR270, IIWA)]
    runs = Parallel(n_jobs=given.jobs, return_as="generator")(
        delayed(one_arm)(name, seed, given.targets) for name, seed in cases
    )
    found: list[dict[str, np.ndarray]] = []
    for run in runs:
        found.append(run)
        told(*cases[len(found) - 1], run)
    text = table(cases, found)
    print(text)
    (HERE / "result.md").write_text(text, encoding="utf-8")


def told(name: str, seed: int, run: dict[str, np.ndarray]) -> None:
    """One line per arm, as it is done."""
    after, stated = np.linalg.norm(run["after"], axis=1), stated_size(run["covariance"])
    print(
        f"{name}, arm {seed}: {len(after)} of {run['asked']} reached, before "
        f"{three(run['before'])}, after {three(run['after'])} µm, stated {rms(stated) * 1e6:.1f} "
        f"µm, undetermined {rms(run['unknown']) * 1e6:.2f} µm",
        flush=True,
    )


def stated_size(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2))


class TrueArm:
    """An arm in MuJoCo with errors of its own, seen from a tracker that stands anywhere."""

    def __init__(self, name: str, chain: Chain, rng: np.random.Generator) -> None:
        n = chain.n_joints
        self.offset = ANGLE * rng.normal(size=n)
        self.T = pose(rng.uniform(-3, 3, 3), Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)))
        self.T[:3, :3] @= Rotation.from_rotvec(3e-3 * rng.normal(size=3)).as_matrix()
        errors = [
            pose(LENGTH * rng.normal(size=3), Rotation.from_rotvec(ANGLE * rng.normal(size=3)))
            for _ in range(n)
        ]
        # As an error at the distal end of link i: the next joint's placement is off.
        joints = [
            replace(joint, placement=joint.placement @ error)
            for joint, error in zip(chain.joints, [np.eye(4), *errors[:-1]], strict=True)
        ]
        end = chain.flange_placement @ errors[-1]
        real = replace(chain, joints=tuple(joints), flange_placement=end, masses=())
        k = np.array(COMPLIANCE[name]) * (1 + 0.2 * rng.uniform(-1, 1, n))
        places = MARKERS if name == KR270 else SHORT
        self.markers = {m: np.array(p) + 5e-3 * rng.normal(size=3) for m, p in places.items()}
        load_point = (0.20, 0.0, 0.25) if name == KR270 else (0.0, 0.0, 0.1)
        self.arm = MujocoArm(real, k, load_point, self.markers)

    def measure(self, q: np.ndarray, force: np.ndarray) -> dict[str, np.ndarray]:
        """Marker positions (3,) in m in the tracker's frame, commanded to q under `force`."""
        rest = self.arm.equilibrium(q + self.offset, self.T[:3, :3].T @ force)
        observed = self.arm.markers(rest)
        return {m: self.T[:3, :3] @ p + self.T[:3, 3] for m, p in observed.items()}


def pose(place: np.ndarray, turned: Rotation) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned.as_matrix(), place
    return T


def one_arm(name: str, seed: int, count: int) -> dict[str, np.ndarray]:
    """Errors before and after (targets, 3) m, stated covariances, and how many were reached."""
    rng = np.random.default_rng([seed, list(FORCE).index(name)])
    with tempfile.TemporaryDirectory() as folder:
        cell_path = cell_file(name, Path(folder))
        cell = read_cell(cell_path)
        chain = load_chain(cell)
        truth = TrueArm(name, chain, rng)
        load = np.array([0.0, 0.0, -FORCE[name]])
        data, result = Path(folder) / "data.csv", Path(folder) / "result.json"
        q = regular_poses(chain, cell, POSES, rng)
        write_measurements(measured(truth, q, load, rng), data)
        command = [sys.executable, "-m", "elastocal", "identify", cell_path, data, "-o", result]
        subprocess.run([*command, "-q"], check=True, capture_output=True)
        targets = Path(folder) / "targets.csv"
        write_targets(truth, chain, regular_poses(chain, cell, count, rng), load, targets)
        arm = read_calibrated(cell_path, result)
        wanted = read_targets(targets, chain.kinds, "tracker")
        found = compensate(arm, wanted, tool_point(arm.model.cell, "M1"))
    good = np.flatnonzero(found.reached)
    place = wanted.position[good]
    return {
        "before": np.array([truth.measure(found.nominal[i], load)["M1"] for i in good]) - place,
        "after": np.array([truth.measure(found.q[i], load)["M1"] for i in good]) - place,
        "covariance": found.uncertainty.covariance[good],
        "unknown": found.uncertainty.unknown[good],
        "asked": np.array(len(wanted)),
    }


def cell_file(name: str, folder: Path) -> Path:
    text = (HERE / "kr270.toml").read_text(encoding="utf-8")
    urdf = '"../../src/elastocal/demo/kr270_2.urdf"'
    path = folder / "cell.toml"
    if name == KR270:
        text = text.replace(urdf, f'"{(HERE / urdf[1:-1]).resolve()}"')
    else:
        files = metadata.distribution("rtb-data").files or ()
        robot = next(f for f in files if str(f).endswith("urdf/lbr_iiwa_14_r820.urdf"))
        text = text.replace(urdf, f'"{robot.locate()}"')
        text = text.replace("load_point_m = [0.20, 0.0, 0.25]", "load_point_m = [0.0, 0.0, 0.1]")
    path.write_text(text, encoding="utf-8")
    return path


def regular_poses(chain: Chain, cell: Cell, count: int, rng: np.random.Generator) -> np.ndarray:
    """Poses over 0.9 of the joint ranges that are not near a singular one."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in joint_limits(cell, chain))
    middle, half = (lower + upper) / 2, 0.9 * (upper - lower) / 2
    q = middle + half * rng.uniform(-1, 1, (20 * count, chain.n_joints))
    smallest = np.linalg.svd(jacobians(chain, q), compute_uv=False)[:, -1]
    kept = q[smallest > SMALLEST][:count]
    assert len(kept) == count
    return kept


def jacobians(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Of the flange (N, 6, n) in m and rad, by differences: to tell poses apart, no more."""
    N, n = q.shape
    steps = np.concatenate([q[:, None], q[:, None] + 1e-6 * np.eye(n)], axis=1)
    T = nominal_flanges(chain, steps.reshape(-1, n)).reshape(N, n + 1, 4, 4)
    relative = T[:, 1:, :3, :3] @ T[:, :1, :3, :3].transpose(0, 1, 3, 2)
    turned = Rotation.from_matrix(relative.reshape(-1, 3, 3)).as_rotvec().reshape(N, n, 3)
    moved = T[:, 1:, :3, 3] - T[:, :1, :3, 3]
    return np.concatenate([moved, turned], axis=2).transpose(0, 2, 1) / 1e-6


def measured(
    truth: TrueArm, q: np.ndarray, load: np.ndarray, rng: np.random.Generator
) -> Measurements:
    plan = Measurements.of_poses("data.csv", q, np.zeros(3))
    rows = expand_plan(plan, tuple(truth.markers), 1, load)
    seen = [list(truth.measure(pose, f * load).values()) for pose in q for f in range(2)]
    position = np.array(seen).reshape(-1, 3)
    return replace(rows, position=position + NOISE * rng.normal(size=position.shape))


def write_targets(
    truth: TrueArm, chain: Chain, q: np.ndarray, load: np.ndarray, path: Path
) -> None:
    """Where a perfect arm with this tool, seen by this tracker, would have its tool at q."""
    T = truth.T @ nominal_flanges(chain, q)
    position = T[:, :3, 3] + T[:, :3, :3] @ truth.markers["M1"]
    turned = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(degrees=True)
    head = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,force_x_N,force_y_N,force_z_N"
    values = np.hstack([position * 1e3, turned, np.tile(load, (len(q), 1))])
    np.savetxt(path, values, fmt="%.12g", delimiter=",", header=head, comments="")


def table(cases: list[tuple[str, int]], found: list[dict[str, np.ndarray]]) -> str:
    lines = [
        "| arm | targets | error before µm: rms, 95 %, max | error after µm: rms, 95 %, max | "
        "stated uncertainty rms µm | error / stated | in 95 % region |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in (KR270, IIWA):
        mine = [f for (n, _), f in zip(cases, found, strict=True) if n == name]
        before, after = (np.concatenate([f[key] for f in mine]) for key in ("before", "after"))
        covariance = np.concatenate([f["covariance"] for f in mine])
        stated = stated_size(covariance)
        normal = np.einsum("ni,ni->n", after, np.linalg.solve(covariance, after[..., None])[..., 0])
        asked = sum(int(f["asked"]) for f in mine)
        ratio = rms(np.linalg.norm(after, axis=1)) / rms(stated)
        lines.append(
            f"| {name}, {len(mine)} arms | {len(after)} of {asked} reached | {three(before)} | "
            f"{three(after)} | {rms(stated) * 1e6:.1f} | {ratio:.2f} | "
            f"{np.mean(normal < chi2.ppf(0.95, 3)):.3f} |"
        )
    return "\n".join(lines) + "\n"


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def three(errors: np.ndarray) -> str:
    size = np.linalg.norm(errors, axis=1) * 1e6
    return f"{rms(size):.1f}, {np.quantile(size, 0.95):.1f}, {size.max():.1f}"


if __name__ == "__main__":
    main()
