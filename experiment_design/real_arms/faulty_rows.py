"""The faulty rows of the draw-wire data: which the tool finds, and what they cost on test rows.

ELASTOCAL_DATASETS=… python faulty_rows.py      prints the lists, writes faulty_rows.md
"""

from __future__ import annotations

import numpy as np
from prepare import HERE, prepare

from elastocal.cell.work_cell import read_cell
from elastocal.identification.identify import identify
from elastocal.identification.options import Options
from elastocal.identification.outliers import blocks
from elastocal.identification.result import Calibration
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

SPLITS, TEST_SHARE = 5, 0.2


def rmse(model: Model, result: Calibration, rows: Measurements) -> float:
    """Root mean square error in mm of the predicted cable length."""
    error = observe(rows, model.observe).value - model.predict(rows, result.x)
    return float(np.sqrt(np.mean(error**2))) * 1e3


def main() -> None:
    cell = read_cell(HERE / "irb120.toml")
    data = prepare() / "irb120.csv"
    model = Model(cell)
    table = read_measurements(data, joint_kinds=model.chain.kinds, observe="distance")
    model = Model(cell, table.marker_names)
    whole = identify(model, table, Options(faulty="drop"))
    faulty = np.isin(table.row, [o.line for o in whole.excluded])
    error = observe(table, "distance").value - model.predict(table, whole.x)
    lines = [
        "| faulty lines | readings | error under the fit to the others in mm |",
        "|---|---|---|",
    ]
    for first, last in blocks([o.line for o in whole.excluded]):
        inside = faulty & (table.row >= first) & (table.row <= last)
        mean, spread = error[inside].mean() * 1e3, error[inside].std() * 1e3
        lines.append(f"| {first} to {last} | {inside.sum()} | {mean:+.2f} ± {spread:.2f} |")
    lines += [
        "", "| split | test rows, faulty ones | trained on all: test RMSE mm, on the good rows "
        "| trained without the faulty: on all | on the good rows |", "|---|---|---|---|---|",
    ]  # fmt: skip
    for split in range(SPLITS):
        test = np.random.default_rng(split).random(len(table)) < TEST_SHARE
        train, rest, good = table.take(~test), table.take(test), table.take(test & ~faulty)
        cells = []
        for choice in ("keep", "drop"):
            result = identify(model, train, Options(faulty=choice))
            cells += [f"{rmse(model, result, rest):.2f}", f"{rmse(model, result, good):.2f}"]
        lines.append(
            f"| {split + 1} | {test.sum()}, {(test & faulty).sum()} | {cells[0]}, {cells[1]} "
            f"| {cells[2]} | {cells[3]} |"
        )
    text = "\n".join(lines)
    print(text)
    (HERE / "faulty_rows.md").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
