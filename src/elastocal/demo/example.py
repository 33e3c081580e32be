"""The worked example: the KR 270 of Klimchik et al. 2013, simulated and identified end to end."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from elastocal.files import atomic_write
from elastocal.identification.result import Calibration
from elastocal.messages import InputError

LOAD_N = (0.0, 0.0, -2600.0)  # 265 kg: the paper hung 250 to 280 kg
REPEATS = 6
MARK = "table3_compliances.csv"  # by which an earlier demo's folder is known
MADE = ("data.csv", "result.json", "report.html")
SEED = 2013
UNSEEN_COMPLIANCE = 0.35e-6  # rad/(N m); joint 1, which a vertical load cannot show


@dataclass(frozen=True)
class Demo:
    """What the demo did: its files, the true values, and what was found."""

    cell: Path
    plan: Path
    data: Path
    truth: dict[str, float]
    published: dict[str, tuple[float, float]]
    result: Calibration


def run_demo(
    folder: Path, seed: int = SEED, progress: Callable[[str], None] = lambda message: None
) -> Demo:
    """Table 2's poses, Table 1's noise and Table 3's WLS compliances, measured and identified.

    Writes cell, robot, plan and data into `folder`, so that every step can be repeated by hand.
    Table 1 states the spread of deflections, the difference of two readings, so each reading
    gets 1/√2 of it.  Raises InputError where the folder cannot be written, or holds files of the
    same names that are not the example's.
    """
    from elastocal.cell import read_cell
    from elastocal.identification.identify import identify
    from elastocal.model.manipulator import Model
    from elastocal.simulation import expand_plan, simulate, values_from

    progress("copying the example")
    cell_path, plan_path = _copy_example(folder)
    cell = read_cell(cell_path)
    model = Model(cell)
    plan = model.read_plan(plan_path)
    rows = expand_plan(plan, tuple(cell.tool.markers), REPEATS, np.array(LOAD_N))
    rows = replace(rows, sigma=reading_sigma(folder)[rows.configuration])
    truth, published = published_compliances(folder)
    progress(f"measuring {len(rows)} simulated readings")
    table = simulate(model, rows, values_from(model, truth), seed)
    data_path = folder / "data.csv"
    table.save(data_path)
    result = identify(model, replace(table, source=str(data_path)), progress=progress)
    return Demo(cell_path, plan_path, data_path, truth, published, result)


def _copy_example(folder: Path) -> tuple[Path, Path]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder}: is or lies in a file; name a folder for the demo") from None
    except PermissionError:
        raise InputError(f"{folder}: no permission to make this folder; name another") from None
    with as_file(files("elastocal.demo")) as source:
        own = [path for path in source.iterdir() if path.suffix in (".toml", ".urdf", ".csv")]
        # A campaign of somebody's own, or an example changed since, is not written over.
        there = {folder / path.name: path for path in own if (folder / path.name).exists()}
        foreign = [path for path, ours in there.items() if path.read_bytes() != ours.read_bytes()]
        foreign += [folder / n for n in MADE if folder / MARK not in there]
        for path in (path for path in foreign if path.exists()):
            raise InputError(
                f"{path} is not the demo's and would be written over; name another folder"
            )
        for path in own:
            atomic_write(folder / path.name, path.read_text(encoding="utf-8"))
    return folder / "cell.toml", folder / "plan.csv"


def _rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as handle:
        return list(csv.DictReader(handle))


def reading_sigma(folder: Path) -> np.ndarray:
    """Standard deviation (configurations, 3) in m of one reading, from Table 1."""
    table = _rows(folder / "table1_noise.csv")
    deflection = np.array([[float(row[f"sigma_{a}_um"]) for a in "xyz"] for row in table])
    return deflection * 1e-6 / np.sqrt(2)


def published_compliances(folder: Path) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """True values in rad/(N m), and the published OLS value with its ±3σ, by parameter name."""
    truth = {"joint1.compliance": UNSEEN_COMPLIANCE}
    published = {}
    for row in _rows(folder / MARK):
        key = row["parameter"]
        joint, level = key[1], key[2:]
        name = f"joint{joint}.compliance" + (f"_level{level}" if level else "")
        truth[name] = float(row["wls_urad_per_Nm"]) * 1e-6
        published[name] = (
            float(row["ols_urad_per_Nm"]) * 1e-6,
            float(row["ols_ci3sigma_urad_per_Nm"]) * 1e-6,
        )
    return truth, published
