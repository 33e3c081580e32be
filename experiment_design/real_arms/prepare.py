"""Bring the public measurements into elastocal's own table format.

    python prepare.py            reads the folder named by ELASTOCAL_DATASETS, writes data/

Nothing here belongs to the project: data/ is not committed, and two of the four sets may not be
redistributed.  README.md says where each comes from.
"""

from __future__ import annotations

import csv
import os
import random
import shutil
import sys
from datetime import datetime
from pathlib import Path

HERE = Path(__file__).parent
G = 9.80665
SETS = ("ur5_wam_tsinghua", "iiwa7_payload_torque", "robotcali_irb120_cable", "ur10_ipa_leica")
SEED = 18  # of what is drawn
# The UR10: poses for test, sizes of the training sets, poses in a row of the harder split.
TESTED, TRAINED, BLOCK = 2000, (100, 600, 3000), 100


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

    `iiwa7_test.csv` holds a fifth of the configurations, drawn at random, `iiwa7_train.csv` the
    others.  Row 0 is another configuration in each run (see the set's README) and is left out.
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
    configurations = sorted({row[0] for row in rows}, key=int)
    tested = set(random.Random(SEED).sample(configurations, len(configurations) // 5))
    write(out / "iiwa7_test.csv", header, [row for row in rows if row[0] in tested])
    write(out / "iiwa7_train.csv", header, [row for row in rows if row[0] not in tested])


def cable(source: Path, out: Path) -> None:
    """Draw-wire encoder: joints and cable length."""
    shutil.copyfile(source / "nominal_dh.csv", out / "irb120_dh.csv")
    joints = [f"q{i + 1}_rad" for i in range(6)]
    rows = [
        [row[c] for c in (*joints, "cable_L_mm")] for row in rows_of(source / "measurements.csv")
    ]
    write(out / "irb120.csv", [*joints, "distance_mm"], rows)


def ur10(source: Path, out: Path) -> None:
    """A grid measured over days, one reading per configuration, in two splits.

    `ur10_test.csv` and `ur10_100.csv`, `ur10_600.csv`, `ur10_3000.csv`: drawn at random, each
    training set part of the next.  `ur10_blocks_…`: the same numbers of poses in whole blocks of
    100 measured one after the other, so that the test poses lie elsewhere and at other times.
    `ur10_first_…`: the first 600 poses, one corner of the work space, against 2000 of all others.
    """
    shutil.copyfile(source / "nominal_dh.csv", out / "ur10_dh.csv")
    joints = [f"q{i + 1}_rad" for i in range(6)]
    read = rows_of(source / "series_A_6000.csv")
    at = [datetime.strptime(row["timestamp"], "%Y%m%d%H%M%S") for row in read]
    rows = [
        [row[c] for c in (*joints, "x_mm", "y_mm", "z_mm")]
        + [f"{(when - at[0]).total_seconds():.0f}", row["air_temp_C"]]
        for row, when in zip(read, at, strict=True)
    ]
    header = [*joints, "x_mm", "y_mm", "z_mm", "time_s", "temperature_C"]

    def store(name: str, chosen: list[int]) -> None:
        write(out / f"ur10_{name}.csv", header, [rows[k] for k in sorted(chosen)])

    order = random.Random(SEED).sample(range(len(rows)), len(rows))
    store("test", order[:TESTED])
    for count in TRAINED:
        store(str(count), order[TESTED : TESTED + count])
    starts = random.Random(SEED).sample(range(0, len(rows), BLOCK), len(rows) // BLOCK)
    blocks = [k for start in starts for k in range(start, min(start + BLOCK, len(rows)))]
    store("blocks_test", blocks[:TESTED])
    store("blocks_600", blocks[TESTED : TESTED + 600])
    store("first_600", list(range(600)))
    store("first_test", [k for k in order if k >= 600][:TESTED])


def prepare(out: Path = HERE / "data") -> Path:
    """Write all tables to `out`; raises SystemExit where the data sets are not to be found."""
    root = os.environ.get("ELASTOCAL_DATASETS")
    if not root or not Path(root).is_dir():
        sys.exit(
            f"set ELASTOCAL_DATASETS to the folder with {', '.join(SETS)}; README.md says where to "
            "get them"
        )
    out.mkdir(parents=True, exist_ok=True)
    tracker, torques, wire, grid = (Path(root) / name for name in SETS)
    tracker_arm(tracker, out, "ur5", 6)
    tracker_arm(tracker, out, "wam", 7)
    iiwa(torques, out)
    cable(wire, out)
    ur10(grid, out)
    return out


if __name__ == "__main__":
    prepare()
