"""Does a compensated command put a real tool where it should be?  Asked of arms in MuJoCo.

    python experiment_design/compensation/study.py [--arms 3] [--targets 500] [--jobs 2]

The arms of the blind check (`../blind_diagnosis`: errors of base, offsets, links, markers and
compliances, the weights of the links, a tracker anywhere, joints that settle anew at each visit)
are measured with and without their payload, identified by `identify`, and commanded by
`compensate` to targets in the tracker's frame, under the load.  MuJoCo says where the
tool really goes.  Writes result.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from scipy.stats import chi2

import elastocal as ec

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "blind_diagnosis"))

from arm_data import ARMS  # noqa: E402
from draw import Recipe, World, draw_poses  # noqa: E402
from world import Visits  # noqa: E402
from world_files import write_world  # noqa: E402

NOISE, POSES = 20e-6, 60  # m, rms of a coordinate; poses measured
SINGULAR = 0.2  # rad, of the wrist's middle joint: targets stay away from where it is straight


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--arms", type=int, default=3)
    options.add_argument("--targets", type=int, default=500)
    options.add_argument("--jobs", type=int, default=2)
    given = options.parse_args()
    cases = [(name, seed) for name in ARMS for seed in range(given.arms)]
    runs = Parallel(n_jobs=given.jobs)(delayed(one_arm)(*case, given.targets) for case in cases)
    lines = [
        "| arm | targets | error before µm: rms, 95 %, max | error after µm: rms, 95 %, max | "
        "stated uncertainty rms µm | error / stated | in 95 % region |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, spec in ARMS.items():
        mine = [run for (n, _), run in zip(cases, runs, strict=True) if n == name]
        before, after, covariance = (np.concatenate(parts) for parts in zip(*mine, strict=True))
        stated = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        square = np.einsum("ni,nij,nj->n", after, np.linalg.inv(covariance), after)
        lines.append(
            f"| {name}, {spec.payload:g} N, {len(mine)} arms | {len(after)} of "
            f"{len(mine) * given.targets} reached | {three(before)} | {three(after)} | "
            f"{rms(stated) * 1e6:.1f} | {rms(np.linalg.norm(after, axis=1)) / rms(stated):.2f} | "
            f"{np.mean(square < chi2.ppf(0.95, 3)):.3f} |"
        )
    text = "\n".join(lines) + "\n"
    print(text)
    (HERE / "result.md").write_text(text, encoding="utf-8")


def one_arm(name: str, seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors before and after (targets, 3) m, and the stated covariances."""
    recipe = Recipe(f"{name}-{seed}", (16, list(ARMS).index(name), seed), poses=POSES, arm=name,
                    level=NOISE)  # fmt: skip
    world = recipe.draw()
    with tempfile.TemporaryDirectory() as folder:
        seen = Path(folder) / "seen"
        write_world(world, seen, Path(folder) / "sealed")
        fit = ec.identify(seen / "cell.toml", seen / "data.csv")
    wanted, load = targets(world, count), [0.0, 0.0, -world.spec.payload]
    found = ec.compensate(fit, wanted, load=load, frame="tracker", point="M1")
    good = np.flatnonzero(found.reached)
    before, after = (
        at_rest(world, q[good]) - wanted[good, :3, 3] for q in (found.nominal, found.q)
    )
    return before, after, found.uncertainty.covariance[good]


def targets(world: World, count: int) -> np.ndarray:
    """Where (n, 4, 4) a perfect arm with this tool, seen by this tracker, would have marker M1 at
    random poses."""
    rng, true = np.random.default_rng((*world.seed, 5)), world.specimen.true
    q = draw_poses(world.spec, 3 * count, rng)
    q = q[np.abs(np.sin(q[:, -2])) > SINGULAR][:count]
    R, p = world.spec.skeleton.forward(q)
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3] = true.base_rotation @ R[:, -1]
    T[:, :3, 3] = true.base_position + p[:, -1] @ true.base_rotation.T
    T[:, :3, 3] += T[:, :3, :3] @ true.markers[0]
    return T


def at_rest(world: World, q: np.ndarray) -> np.ndarray:
    """Where marker M1 (n, 3) stands under the load, commanded to q (n, joints)."""
    force = np.tile([0.0, 0.0, -world.spec.payload], (len(q), 1))
    visits = Visits(q, force, np.zeros(len(q)), np.zeros(q.shape), np.arange(len(q)))
    return world.noise_free(visits)[:, 0]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def three(errors: np.ndarray) -> str:
    size = np.linalg.norm(errors, axis=1) * 1e6
    return f"{rms(size):.1f}, {np.quantile(size, 0.95):.1f}, {size.max():.1f}"


if __name__ == "__main__":
    main()
