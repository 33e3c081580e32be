"""Identify the real arms of the public data sets, by elastocal's own command line.

ELASTOCAL_DATASETS=… python run.py      prints a table, writes result.md and out/*.json
"""

from __future__ import annotations

from pathlib import Path

from diagnose import OUT, identified, mm
from prepare import HERE, prepare

KEEP, DROP = ("--outliers", "keep"), ("--outliers", "drop")
# label, cell, data, test data, options
RUNS: tuple[tuple[str, str, str, str | None, tuple[str, ...]], ...] = (
    ("UR5, 1000 poses", "ur5.toml", "ur5_grid.csv", "ur5_random.csv", ()),
    ("WAM, 216 poses", "wam.toml", "wam_grid.csv", "wam_random.csv", ()),
    ("iiwa 7, rigid", "iiwa7_rigid.toml", "iiwa7.csv", None, ()),
    ("iiwa 7, rigid, encoder scales", "iiwa7_rigid_scale.toml", "iiwa7.csv", None, ()),
    ("iiwa 7, scales and compliance of joint 2", "iiwa7_joint2.toml", "iiwa7.csv", None, ()),
    ("iiwa 7, scales and all compliances", "iiwa7.toml", "iiwa7.csv", None, ()),
    ("IRB 120 by cable, as is", "irb120.toml", "irb120.csv", None, KEEP),
    ("IRB 120 by cable, faulty left out", "irb120.toml", "irb120.csv", None, DROP),
)
HEADER = (
    "| run | fitted | nominal rms | fit rms | held-out rms | test mean | test max | left out |\n"
    "|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    data = prepare()
    OUT.mkdir(exist_ok=True)
    lines = [HEADER]
    print("\nErrors in mm: rms and mean of the 3-D position error, of the length for cables.\n")
    print(HEADER)
    for k, (label, cell, table, test, options) in enumerate(RUNS):
        more = (*options, *(("--test", data / test) if test else ()))
        found = identified(HERE / cell, data / table, f"{k}_{Path(cell).stem}", *more)
        tested = found["test"] or {}
        lines.append(
            f"| {label} | {len(found['covariance_of'])} | {mm(found['nominal_rms_um'])} "
            f"| {mm(found['residual_rms_um'])} | {mm(found['heldout_rms_um'])} "
            f"| {mm(tested.get('mean_um'))} | {mm(tested.get('max_um'))} "
            f"| {len(found['excluded'])} of {len(found['excluded']) + found['n_readings']} |"
        )
        print(lines[-1], flush=True)
    (HERE / "result.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
