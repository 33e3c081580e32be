"""Bring the public measurements into elastocal's own table format.

    python prepare.py            reads the folder named by ELASTOCAL_DATASETS, writes data/

Nothing here belongs to the project: data/ is not committed, and two of the three sets may not be
redistributed.  README.md says where each comes from.
"""

from __future__ import annotations

import csv
import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
G = 9.80665


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def write(path: Path, header: list[str], rows: list[list[str]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    print(f"{path.name}: {len(rows)} rows")


def tracker_arm(source: Path, out: Path, name: str, joints: int) -> None:
    """Laser tracker, positions only: commanded joints and measured x, y, z."""
    joint_columns = [f"q{i + 1}_rad" for i in range(joints)]
    columns = [*joint_columns, "x_mm", "y_mm", "z_mm"]
    shutil.copyfile(source / f"nominal_dh_{name}.csv", out / f"{name}_dh.csv")
    for part in ("grid", "random"):
        rows = [[row[c] for c in columns] for row in rows_of(source / f"{name}_{part}.csv")]
        write(out / f"{name}_{part}.csv", columns, rows)


def iiwa(source: Path, out: Path) -> None:
    """Three payloads in one table; each payload is a tool of its own, so a marker of its own.

    Row 0 is another configuration in each run (see the set's README) and is left out.
    """
    shutil.copyfile(source / "nominal_dh.csv", out / "iiwa7_dh.csv")
    joints = [f"q{i + 1}_rad" for i in range(7)]
    torques = [f"tau{i + 1}_Nm" for i in range(7)]
    header = ["configuration", "marker", *joints, *[f"torque_{i + 1}_Nm" for i in range(7)]]
    header += ["force_x_N", "force_y_N", "force_z_N", "x_mm", "y_mm", "z_mm"]
    rows = []
    for label in ("0kg", "1p25kg", "2p5kg"):
        for row in rows_of(source / f"load_{label}.csv")[1:]:
            weight = -G * float(row["payload_kg"])
            values = [row[c] for c in (*joints, *torques)]
            position = [row[c] for c in ("x_mm", "y_mm", "z_mm")]
            rows.append([row["seq"], label, *values, "0", "0", repr(weight), *position])
    write(out / "iiwa7.csv", header, rows)


def cable(source: Path, out: Path) -> None:
    """Draw-wire encoder: joints and cable length."""
    shutil.copyfile(source / "nominal_dh.csv", out / "irb120_dh.csv")
    joints = [f"q{i + 1}_rad" for i in range(6)]
    rows = [
        [row[c] for c in (*joints, "cable_L_mm")] for row in rows_of(source / "measurements.csv")
    ]
    write(out / "irb120.csv", [*joints, "distance_mm"], rows)


def prepare(out: Path = HERE / "data") -> Path:
    """Write all tables to `out`; raises SystemExit where the data sets are not to be found."""
    root = os.environ.get("ELASTOCAL_DATASETS")
    if not root or not Path(root).is_dir():
        sys.exit(
            "set ELASTOCAL_DATASETS to the folder with ur5_wam_tsinghua, iiwa7_payload_torque and "
            "robotcali_irb120_cable; README.md says where to get them"
        )
    out.mkdir(parents=True, exist_ok=True)
    tracker_arm(Path(root) / "ur5_wam_tsinghua", out, "ur5", 6)
    tracker_arm(Path(root) / "ur5_wam_tsinghua", out, "wam", 7)
    iiwa(Path(root) / "iiwa7_payload_torque", out)
    cable(Path(root) / "robotcali_irb120_cable", out)
    return out


if __name__ == "__main__":
    prepare()
