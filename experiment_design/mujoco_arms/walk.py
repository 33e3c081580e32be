"""From a MuJoCo model to the same file calibrated, by the verbs as the README has them.

    python experiment_design/mujoco_arms/walk.py panda.xml iiwa14.xml [--out FOLDER]

For each file: `init`, `design`, `simulate --draw 1` (an arm that differs), `identify`, `export` in
place, nothing edited.  Then both files are loaded in MuJoCo, which knows nothing of elastocal: the
markers of the written file at rest, unloaded and under the load, at random poses, against those of
the identified model and of the true arm.  Prints a row of README.md for each.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import elastocal as ec

Array = NDArray[np.float64]
POSES = 50
SPRING, MARKER, LOAD = "elastocal_spring_", "elastocal_marker_", "elastocal_load_point"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("files", nargs="+", type=Path)
    options.add_argument("--out", type=Path)
    given = options.parse_args()
    out = given.out or Path(tempfile.mkdtemp())
    for file in given.files:
        folder = out / file.resolve().parent.name
        folder.mkdir(parents=True, exist_ok=True)
        print(walked(file.resolve(), folder), flush=True)


def walked(file: Path, folder: Path) -> str:
    """Goes the way with one arm; a row of the README's table."""
    told = verb(folder, f"init {shlex.quote(str(file))} --force")
    steps = [line.strip().removeprefix("elastocal ") for line in told.splitlines() if "  " in line]
    for step in steps:  # design and simulate, as init says them
        verb(folder, f"{step} {'--truth truth.json' if step.startswith('simulate') else '--quiet'}")
    load = np.array(re.findall(r"--load (\S+) (\S+) (\S+)", steps[-1])[0], dtype=float)
    verb(folder, "identify cell.toml data.csv -o result.json --report report.html --quiet")
    written = file.with_name(f"{file.stem}_calibrated.xml")  # beside its meshes
    words = " ".join(map("{:g}".format, load))
    verb(folder, f"export cell.toml result.json -o {shlex.quote(str(written))} --load {words}")
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    as_identified, to_truth = compared(folder, file, written, load)
    verdict, about = result["verdict"], len(result["parameters"])
    return (
        f"| {file.parent.name}/{file.name} | {about} | {verdict['tone']}, "
        f"{verdict['at_um']:.1f} µm | {result['nominal_rms_um'] / 1e3:.2f} mm | "
        f"{as_identified:.4f} µm | {to_truth:.1f} µm |"
    )


def verb(folder: Path, line: str) -> str:
    """What a verb prints; its words are shown, and a failure ends the walk."""
    print(f"$ elastocal {line}", file=sys.stderr, flush=True)
    done = subprocess.run(
        [sys.executable, "-m", "elastocal", *shlex.split(line)],
        cwd=folder, capture_output=True, text=True, env=os.environ | {"COLUMNS": "100"},
    )  # fmt: skip
    print(done.stdout + done.stderr, file=sys.stderr, flush=True)
    if done.returncode:
        raise SystemExit(done.returncode)
    return done.stdout


def compared(folder: Path, nominal: Path, written: Path, load: Array) -> tuple[float, float]:
    """In µm: the most that MuJoCo's markers are off those of the identified model, and the rms by
    which they are off those of the true arm, at random poses without and under the load.

    MuJoCo's world and the data's frame differ by one motion, which is fitted to the unloaded poses.
    """
    arm = ec.read_calibrated(folder / "cell.toml", folder / "result.json")
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    model = arm.model
    lower, upper = np.array(
        [model.cell.limits[f"joint{i + 1}"] for i in range(model.chain.n_joints)]
    ).T
    q = np.random.default_rng(7).uniform(lower, upper, (POSES, len(lower)))
    places = [
        ec.simulate(model, q, values=values, load=load, noise=False).position
        for values in (dict(zip(model.names, arm.x, strict=True)), truth)
    ]
    names = tuple(model.cell.tool.markers)
    found, true = (p.reshape(POSES, 2, len(names), 3) for p in places)
    joints = [joint.name for joint in model.chain.joints]
    free = np.stack([at_rest(written, joints, row, np.zeros(3), names) for row in q])
    turn, shift = motion(free.reshape(-1, 3), found[:, 0].reshape(-1, 3))
    loaded = np.stack([at_rest(written, joints, row, turn.inv().apply(load), names) for row in q])
    both = turn.apply(np.stack([free, loaded], axis=1).reshape(-1, 3)) + shift
    off = [np.linalg.norm(both - p.reshape(-1, 3), axis=1) * 1e6 for p in (found, true)]
    mujoco.MjModel.from_xml_path(str(nominal))  # loads still
    return float(off[0].max()), float(np.sqrt((off[1] ** 2).mean()))


def motion(of: Array, to: Array) -> tuple[Rotation, Array]:
    """The turn and shift that bring points `of` (n, 3) to points `to`."""
    turn = Rotation.align_vectors(to - to.mean(axis=0), of - of.mean(axis=0))[0]
    return turn, to.mean(axis=0) - turn.apply(of.mean(axis=0))


def at_rest(file: Path, joints: list[str], q: Array, force: Array, names: tuple[str, ...]) -> Array:
    """Markers (m, 3) in MuJoCo's world: joints held at q, springs at rest under weights and force.

    k s = Jᵀ F − g(s) for the springs' turns s, by Jacobi's iteration.
    """
    model = LOADED.setdefault(file, mujoco.MjModel.from_xml_path(str(file)))
    data = mujoco.MjData(model)
    for name, value in zip(joints, q, strict=True):
        data.joint(name).qpos = value
    springs = [j for j in range(model.njnt) if model.joint(j).name.startswith(SPRING)]
    at, dof = model.jnt_qposadr[springs], model.jnt_dofadr[springs]
    for _ in range(200):
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(LOAD).id)
        moment = jacobian.T @ force - data.qfrc_bias
        step = moment[dof] / model.jnt_stiffness[springs] - data.qpos[at]
        data.qpos[at] += step
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    mujoco.mj_forward(model, data)
    return np.array([data.site(f"{MARKER}{name}").xpos for name in names])


LOADED: dict[Path, mujoco.MjModel] = {}

if __name__ == "__main__":
    main()
