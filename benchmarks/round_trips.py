"""Round trips of packaged arms: does what `export` writes predict poses that nobody fitted?

For every arm of the packages example-robot-data and rtb-data: `init`, 40 random poses measured
(simulated with true errors of typical size, with and without load), `identify` on 32 of them,
`export` to each format; then each file is read by another program (URDF by pinocchio, MJCF by
MuJoCo at rest under the load, DH tables by elastocal's reader), which predicts the markers in the 8
poses left.  A file passes where its error is at most 1.3 times noise and stated loss together.

    python benchmarks/round_trips.py [ARM …] [-o docs/round-trips.md]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import elastocal as ec
from elastocal.export.export import Wish, export
from elastocal.export.robot_files import MujocoRest, urdf_flanges
from elastocal.measurements import Measurements
from elastocal.messages import ElastocalError
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.dh import read_dh
from elastocal.model.rigid import nominal_flanges
from elastocal.units import Array, rotation_from_rpy

PACKAGES = ("example-robot-data", "rtb-data")
# Of robots with several arms: URDF → flange.
ARMS = {
    "baxter": "left_gripper_base_link", "pr2": "l_gripper_palm_link", "romeo": "l_wrist",
    "talos_reduced": "gripper_left_motor_double_link", "tiago_dual": "hand_left_palm_link",
    "tiago_pro": "gripper_left_base_link",
}  # fmt: skip
POSES, FITTED = 40, 32
PASSES = 1.3


def packaged() -> dict[str, Path]:
    """Every URDF of the packages by name; of the same name the first."""
    found: dict[str, Path] = {}
    for package in PACKAGES:
        for file in sorted(metadata.distribution(package).files or (), key=str):
            if file.suffix == ".urdf":
                found.setdefault(file.stem, Path(str(file.locate())))
    return found


@dataclass(frozen=True)
class Trip:
    """Errors in m, 3-D rms at the poses left out; `losses` of each format as `export` states it."""

    name: str
    joints: int
    length: float
    noise: float
    nominal: float
    fitted: float
    errors: dict[str, float]
    losses: dict[str, float]

    def passes(self, form: str) -> bool:
        """Whether a file's error is what noise and stated loss let expect."""
        return self.errors[form] <= PASSES * float(np.hypot(self.noise, self.losses[form]))

    def row(self) -> str:
        """A line of the table: µm; in bold what is beyond noise and stated loss."""
        cells = [self.name, f"{self.joints}", f"{self.length:.2f}"]
        cells += [f"{self.nominal * 1e6:.0f}", f"{self.fitted * 1e6:.0f}"]
        for form in FORMATS:
            told = f"{self.errors[form] * 1e6:.0f} ({self.losses[form] * 1e6:.0f})"
            cells.append(told if self.passes(form) else f"**{told}**")
        return f"| {' | '.join(cells)} |"


def trip(name: str, path: Path, folder: Path, seed: int = 0) -> Trip:
    """One arm there and back.  Raises ElastocalError where it is none that elastocal reads."""
    cell = folder / "cell.toml"
    ec.init(path, cell, flange=ARMS.get(name), force=True)
    model = ec.Model(str(cell))
    low, high = finite_ranges(model.chain, *joint_limits(model.cell, model.chain))
    q = np.random.default_rng(seed).uniform(low, high, (POSES, model.chain.n_joints))
    loads = model.cell.design.loads
    force = np.zeros(3) if loads is None else loads[-1]
    data = ec.simulate(model, q, draw=1.0, load=force, seed=seed)
    fitted = data.take(np.flatnonzero(data.configuration < FITTED))
    left = data.take(np.flatnonzero(data.configuration >= FITTED))
    fit = ec.identify(model, fitted, test=left)
    back, errors, losses = Back(fit, fitted, folder), {}, {}
    for form, (ending, read) in FORMATS.items():
        # A rigid file says nothing of the load, which its stated loss is without.
        acting = force if form == "mjcf" else np.zeros(3)
        wish = Wish(folder / f"out{ending}", form, acting, True, form == "urdf",
                       None, None, 500, seed)  # fmt: skip
        done = export(fit.arm, wish)
        rows = left if form == "mjcf" else unloaded(left)
        apart = read(back, done.text, rows) - rows.position
        errors[form] = float(np.sqrt((apart**2).sum(axis=1).mean()))
        losses[form] = done.cost.total.marker_max
    noise = model.cell.tracker.noise.sigma  # type: ignore[union-attr]
    return Trip(
        name, model.chain.n_joints, sum(model.chain.lengths), float(np.linalg.norm(noise)),
        fit.nominal_rms, fit.test.rms, errors, losses,
    )  # fmt: skip


def unloaded(rows: Measurements) -> Measurements:
    return rows.take(np.flatnonzero(~rows.force.any(axis=1)))


@dataclass(frozen=True)
class Back:
    """Other programs read the files of a fit and predict markers (n, 3) in the tracker's frame."""

    fit: ec.Calibration
    fitted: Measurements
    folder: Path

    def urdf(self, text: str, rows: Measurements) -> Array:
        """Frames of the file, in pinocchio."""
        names = [joint.name for joint in self.fit.model.chain.joints]
        found = np.empty((len(rows), 3))
        for k, marker in enumerate(rows.marker_names):
            of_it, frame = rows.marker == k, f"elastocal_marker_{marker}"
            T = urdf_flanges(text, names, "elastocal_tracker", frame, rows.q[of_it])
            found[of_it] = T[:, :3, 3]
        return found

    def mjcf(self, text: str, rows: Measurements) -> Array:
        """In MuJoCo, at rest under each row's force; the world is the robot's base."""
        arm = MujocoRest(text)
        _, T = self.parameters()
        markers = [f"marker_{rows.marker_names[k]}" for k in rows.marker]
        each = zip(rows.q, rows.force, markers, strict=True)
        sites = np.array([arm.sites(q, force, [marker])[0] for q, force, marker in each])
        return sites @ T[:3, :3].T + T[:3, 3]

    def dh(self, text: str, rows: Measurements) -> Array:
        """By elastocal's reader.  The table has no base: it is placed by the rows fitted."""
        path = self.folder / "read.csv"
        path.write_text(text, encoding="utf-8")
        chain = read_dh(path, "standard" if "standard convention" in text else "modified")
        markers, _ = self.parameters()

        def points(table: Measurements) -> Array:
            T = nominal_flanges(chain, table.q)
            own = np.array([markers[table.marker_names[k]] for k in table.marker])
            return np.asarray((T[:, :3, :3] @ own[..., None])[..., 0] + T[:, :3, 3])

        known = unloaded(self.fitted)
        found, seen = points(known), np.asarray(known.position)
        R, _ = Rotation.align_vectors(seen - seen.mean(axis=0), found - found.mean(axis=0))
        return np.asarray(R.apply(points(rows) - found.mean(axis=0)) + seen.mean(axis=0))

    def parameters(self) -> tuple[dict[str, Array], Array]:
        """Markers (3,) in the flange frame and T_tracker_base (4, 4) of the exported parameters."""
        out = self.folder / "out.yaml"
        wish = Wish(out, "yaml", np.zeros(3), True, False, None, None, 2, 0)
        geometry = yaml.safe_load(export(self.fit.arm, wish).text)["geometry"]
        base, T = geometry["tracker_to_base"], np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_from_rpy(base["rpy_rad"]), base["xyz_m"]
        return {name: np.array(at["xyz_m"]) for name, at in geometry["markers"].items()}, T


FORMATS = {
    "urdf": (".urdf", Back.urdf), "mjcf": (".xml", Back.mjcf), "dh": (".csv", Back.dh),
    "mdh": (".csv", Back.dh),
}  # fmt: skip


HEAD = """\
# Round trips

Arms of the packages example-robot-data and rtb-data. For each: a cell by `init`, 40 random poses
simulated with errors of typical size, `identify` on 32 of them, `export` to each format. Another
program reads each file and predicts the markers at the other 8 poses: pinocchio the URDF, MuJoCo
at rest under load the MJCF, elastocal's reader the DH tables (base placed by the fitted poses).
Made by `python benchmarks/round_trips.py -o docs/round-trips.md`.

Errors are 3-D rms in µm with measurement noise, which alone gives {noise:.0f} µm. The nominal arm
has base and markers placed. In brackets: the largest loss of the format as `export` states it,
mostly gravity sag; rigid formats are judged without load. Bold: above 1.3 times noise and loss
together.

| arm | joints | links, m | nominal | model | URDF | MJCF | DH | modified DH |
|---|---|---|---|---|---|---|---|---|
"""


def page(trips: list[Trip], refused: dict[str, str]) -> str:
    """The page of the documentation."""
    good = sum(t.passes(form) for t in trips for form in FORMATS)
    told = f"\n{good} of {len(trips) * len(FORMATS)} files of {len(trips)} arms pass."
    if refused:
        told += f" Not arms of 4 to 9 joints: {len(refused)} other robots (legs, drones, hands)."
    noise = trips[0].noise * 1e6 if trips else 0.0
    return HEAD.format(noise=noise) + "\n".join(t.row() for t in trips) + "\n" + told + "\n"


def main() -> None:
    """Print a line per arm, and write the page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arms", nargs="*")
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    trips, refused = [], {}
    for name, path in packaged().items():
        if asked.arms and name not in asked.arms:
            continue
        with tempfile.TemporaryDirectory() as folder:
            try:
                trips.append(trip(name, path, Path(folder)))
            except ElastocalError as error:
                refused[name] = str(error)
                print(f"{name}: {error}", flush=True)
                continue
        print(trips[-1].row(), flush=True)
    if asked.output is not None:
        asked.output.write_text(page(trips, refused), encoding="utf-8")


if __name__ == "__main__":
    main()
