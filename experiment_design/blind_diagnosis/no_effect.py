"""How often `diagnose` claims something of arms that lack nothing, by what is observed.

    python no_effect.py [--seed S] [--worlds N] [--kinds position,pose,…]

Arms of a DH table with errors of geometry (and springs, for deflections), measured as positions,
poses, deflections or distances, with 18 to 60 poses, noise from 10 µm to 3 mm that half of the
cells state, and joints that repeat to 6 µrad.  The readings come from the few lines of numpy here
and not from elastocal's model.  At most 5 % of the worlds of each kind may be claimed.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import beta

import elastocal as ec

Array = NDArray[np.float64]
KINDS = ("position", "pose", "deflection", "distance")
# theta0, d, a, alpha
DH = np.array([
    [0.0, 0.4, 0.15, -np.pi / 2], [-np.pi / 2, 0.0, 0.6, 0.0], [0.0, 0.0, 0.12, -np.pi / 2],
    [0.0, 0.64, 0.0, np.pi / 2], [0.0, 0.0, 0.0, -np.pi / 2], [np.pi, 0.1, 0.0, 0.0],
])  # fmt: skip
LIMITS = np.radians([90, 55, 60, 160, 100, 180])
MARKERS = np.array([[0.12, 0.02, 0.05], [-0.06, 0.1, 0.08], [-0.05, -0.09, 0.03]])
LOAD, COMPLIANCE = -1000.0, 1e-6  # N, rad/(N·m)
REPEATABILITY = 6e-6
POSES = (18, 30, 60)
GEOMETRY = ["base_frame", "joint_offset", "link_geometry", "marker_position"]
EFFECTS = {
    "position": GEOMETRY,
    "pose": [*GEOMETRY, "marker_orientation"],
    "deflection": ["joint_compliance"],
    "distance": ["joint_offset", "link_geometry", "base_frame", "marker_position"],
}


@dataclass(frozen=True)
class Arm:
    """A specimen: DH table (6, 4), small turns and shifts of every link, base, springs."""

    dh: Array
    tilt: Array
    shift: Array
    base: Rotation
    origin: Array
    springs: Array

    @classmethod
    def drawn(cls, kind: str, rng: np.random.Generator) -> Arm:
        dh = DH + rng.normal(size=DH.shape) * [5e-4, 3e-4, 3e-4, 3e-4]
        base, origin = Rotation.identity(), np.zeros(3)
        tilt = shift = np.zeros((6, 3))
        if kind == "deflection":  # an arm that is as stated: deflections are to tell springs
            dh = DH
        else:
            base = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
            tilt, shift = 3e-4 * rng.normal(size=(6, 3)), 3e-4 * rng.normal(size=(6, 3))
            base = base * Rotation.from_rotvec(rng.normal(size=3) * 0.01)
            origin = np.array([2.0, 1.5, 0.4]) + rng.normal(size=3) * 0.2
        return cls(dh, tilt, shift, base, origin, COMPLIANCE * np.exp(0.5 * rng.normal(size=6)))

    def flange(self, q: Array) -> tuple[Rotation, Array]:
        """In the tracker's frame, of joint angles (n, 6)."""
        turn = Rotation.concatenate([self.base] * len(q))
        at = np.tile(self.origin, (len(q), 1))
        for k, (theta0, d, a, alpha) in enumerate(self.dh):
            turn = turn * Rotation.from_rotvec(np.outer(q[:, k] + theta0, [0, 0, 1]))
            at = at + turn.apply([a, 0, d])
            turn = turn * Rotation.from_rotvec([alpha, 0, 0])
            at = at + turn.apply(self.shift[k])
            turn = turn * Rotation.from_rotvec(self.tilt[k])
        return turn, at

    def loaded(self, q: Array) -> Array:
        """Joint angles at rest under the load, which hangs at the flange."""
        at, step = q, 1e-6 * np.eye(6)
        for _ in range(4):
            slopes = [(self.flange(at + h)[1] - self.flange(at - h)[1])[:, 2] / 2e-6 for h in step]
            at = q + self.springs * LOAD * np.column_stack(slopes)
        return at


@dataclass(frozen=True)
class World:
    kind: str
    poses: int
    sigma: float
    stated: bool
    seed: tuple[int, int]

    def write(self, folder: Path) -> None:
        rng = np.random.default_rng(self.seed)
        arm = Arm.drawn(self.kind, rng)
        header = "theta0_rad,d_m,a_m,alpha_rad"
        np.savetxt(folder / "dh.csv", DH, delimiter=",", header=header, comments="", fmt="%.16g")
        q = rng.uniform(-LIMITS, LIMITS, (self.poses, 6))
        pd.concat(self._readings(arm, q, rng)).to_csv(folder / "data.csv", index=False)
        (folder / "cell.toml").write_text(self._cell)

    @property
    def _markers(self) -> int:
        return 1 if self.kind in ("pose", "distance") else len(MARKERS)

    @property
    def _cell(self) -> str:
        markers = "\n".join(f"M{m + 1} = {MARKERS[m].tolist()}" for m in range(self._markers))
        size = "distance_um" if self.kind == "distance" else "sigma_um"
        noise = f"{size} = {self.sigma * 1e6}\n"
        if self.kind == "pose":
            noise += f"rotation_urad = {self.sigma / 0.3 * 1e6}\n"
        nominal = {
            "distance": "base_position_m = [2, 1.5, 0.4]",
            "deflection": f"joint_compliance = {[COMPLIANCE] * 6}",
        }
        return (
            f'[robot]\ndh = "dh.csv"\n[tool]\nload_point_m = [0, 0, 0]\n[tool.markers_m]\n'
            f"{markers}\n[tracker]\n{'anchor_m = [0, 0, 0]' * (self.kind == 'distance')}\n"
            f'{noise * self.stated}\n[model]\nobserve = "{self.kind}"\n'
            f"effects = {EFFECTS[self.kind]}\n[model.nominal]\n{nominal.get(self.kind, '')}\n"
        )

    def _readings(self, arm: Arm, q: Array, rng: np.random.Generator) -> Iterator[pd.DataFrame]:
        """Of every load state."""

        def settled() -> Array:
            return q + REPEATABILITY * rng.normal(size=q.shape)

        states = [(0.0, settled())]
        if self.kind == "deflection":
            states = [(0.0, settled()), (LOAD, arm.loaded(settled()))]
        for force, at in states:
            turn, origin = arm.flange(at)
            turned = turn * Rotation.from_rotvec(self.sigma / 0.3 * rng.normal(size=(len(q), 3)))
            exact = np.stack([origin + turn.apply(m) for m in MARKERS], axis=1)
            points = exact + self.sigma * rng.normal(size=exact.shape)
            lengths = np.linalg.norm(exact, axis=2)
            lengths = lengths + self.sigma * rng.normal(size=lengths.shape)
            m = self._markers
            rows = pd.DataFrame(np.repeat(q, m, axis=0), columns=[f"q{j}_rad" for j in range(1, 7)])
            rows["configuration"] = np.repeat(np.arange(len(q)) + 1, m)
            rows["marker"] = [f"M{k + 1}" for k in range(m)] * len(q)
            if self.kind == "distance":
                rows["distance_mm"] = 1e3 * lengths[:, 0]
            else:
                rows[["x_mm", "y_mm", "z_mm"]] = 1e3 * points[:, :m].reshape(-1, 3)
            if self.kind == "deflection":
                rows[["force_x_N", "force_y_N", "force_z_N"]] = 0.0, 0.0, force
            if self.kind == "pose":
                rows[["qx", "qy", "qz", "qw"]] = turned.as_quat()
            yield rows


def worlds(kind: str, seed: int, n: int) -> Iterator[World]:
    for k in range(n):
        rng = np.random.default_rng((seed, KINDS.index(kind), k))
        poses = int(rng.choice(POSES)) * (4 if kind == "distance" else 1)
        sigma = float(np.exp(rng.uniform(np.log(1e-5), np.log(3e-3))))
        yield World(kind, poses, sigma, bool(k % 2), (seed, k))


def verdict(world: World) -> str:
    """What `diagnose` says of it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        world.write(folder)
        return ec.diagnose(folder / "cell.toml", folder / "data.csv").verdict


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=20261126)
    parser.add_argument("--worlds", type=int, default=400)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    print("| observed | worlds | claimed | 95 % |\n|---|---|---|---|", flush=True)
    with ProcessPoolExecutor(asked.jobs) as pool:
        for kind in asked.kinds.split(","):
            tried = list(worlds(kind, asked.seed, asked.worlds))
            found = list(pool.map(verdict, tried))
            k, n = len(tried) - found.count("nothing_significant"), len(tried)
            low, high = beta.ppf([0.025, 0.975], [k, k + 1], [n - k + 1, n - k])
            print(f"| {kind} | {n} | {k} | {np.nan_to_num(low):.3f} to {high:.3f} |", flush=True)


if __name__ == "__main__":
    main()
