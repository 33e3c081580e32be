"""Steps that are not one command: calls of the front door, and what prepares a command's input.

Each takes the folder that it runs in, and returns what is kept (nothing: it only prepares).
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import elastocal as ec


def append_extra(folder: Path) -> None:
    """The tutorial's `sed 1d extra_data.csv >> data.csv`."""
    _, *lines = (folder / "extra_data.csv").read_text(encoding="utf-8").splitlines()
    with open(folder / "data.csv", "a", encoding="utf-8") as handle:
        handle.writelines(line + "\n" for line in lines)


def append_side(folder: Path) -> None:
    """The same with the sideways pull, as another configuration: `s/^9,/10,/`."""
    _, *lines = (folder / "side_data.csv").read_text(encoding="utf-8").splitlines()
    with open(folder / "data.csv", "a", encoding="utf-8") as handle:
        handle.writelines("10," + line.removeprefix("9,") + "\n" for line in lines)


def first(n: int) -> Callable[[Path], None]:
    """Prepares data.csv of its first n configurations."""

    def shortened(folder: Path) -> None:
        header, *lines = (folder / "data.csv").read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if int(line.partition(",")[0]) < n]
        (folder / "data.csv").write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")

    return shortened


def spoil_three(folder: Path) -> None:
    """Three faulty readings in placed.csv, 0.4 to 3 mm off."""
    _spoil(folder / "placed.csv", (5, "x_m", 3e-3), (18, "z_m", -1e-3), (33, "y_m", 4e-4))


def _spoil(path: Path, *faults: tuple[int, str, float]) -> None:
    """Move the reading of a row and column, in m."""
    with open(path, newline="", encoding="utf-8") as handle:
        header, *rows = csv.reader(handle)
    for row, name, off in faults:
        k = header.index(name)
        rows[row][k] = f"{float(rows[row][k]) + off:.8f}"
    path.write_text("\n".join(",".join(r) for r in (header, *rows)) + "\n", encoding="utf-8")


def curved(folder: Path) -> None:
    """curved.toml: the placed arm with error curves of two joints and unknown link weights, poses
    to measure it at, and what is known of it besides."""
    text = (folder / "placed.toml").read_text(encoding="utf-8")
    more = ('"joint_curve:joint1", "joint_curve:joint2", "link_weights", "marker_position"]',)
    text = text.replace('"marker_position"]', *more)
    for joint, low, high, length in ((1, -1.5, 1.5, 0.5), (2, -1.8, -0.4, 0.4)):
        text += f"""
[model.nominal.settings.joint{joint}]
curve_size_rad = 4e-4
curve_length_rad = {length}
curve_low_rad = {low}
curve_high_rad = {high}
"""
    (folder / "curved.toml").write_text(text, encoding="utf-8")
    limits = np.array([[-1.5, -1.8, 0.2, -2.0, -1.5, -2.0], [1.5, -0.4, 2.0, 2.0, 1.5, 2.0]])
    q = np.random.default_rng(5).uniform(*limits, (45, 6))
    header = ",".join(f"q{i}_rad" for i in range(1, 7))
    np.savetxt(folder / "turns.csv", q, "%.6f", delimiter=",", header=header, comments="")
    stated = (
        '[prior."joint2.compliance"]\nmean = 2.9e-7\nstd = 2e-8\n'
        '[[bounds]]\nparameter = "joint3.offset"\nlower = 0.0\n'
    )
    (folder / "curved_knowledge.toml").write_text(stated, encoding="utf-8")


def spoil_two(folder: Path) -> None:
    """Two faulty readings in curved.csv, as far off as its curves move the arm."""
    _spoil(folder / "curved.csv", (12, "x_m", 4e-4), (61, "z_m", 4e-4))


def equal_noise(folder: Path) -> None:
    """noise.csv: 10 µm of noise on every direction of the deflections of data.csv."""
    with open(folder / "data.csv", newline="", encoding="utf-8") as handle:
        n = 3 * sum(float(row["force_z_N"]) != 0 for row in csv.DictReader(handle))
    np.savetxt(folder / "noise.csv", 1e-10 * np.eye(n), fmt="%.3g", delimiter=",")


def thinned_ur5(folder: Path) -> None:
    """Every fourteenth pose of the UR5's grid, with the 20 random poses to test on."""
    source = Path(os.environ["ELASTOCAL_DATASETS"]) / "ur5_wam_tsinghua"
    (folder / "data").mkdir()
    table = (source / "nominal_dh_ur5.csv").read_text(encoding="utf-8")
    (folder / "data" / "ur5_dh.csv").write_text(table, encoding="utf-8")
    columns = [*(f"q{i}_rad" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"]
    for name, step in (("grid", 14), ("random", 1)):
        with open(source / f"ur5_{name}.csv", newline="", encoding="utf-8") as handle:
            rows = [[row[c] for c in columns] for row in csv.DictReader(handle)]
        lines = [",".join(row) for row in (columns, *rows[::step])]
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def names(folder: Path) -> dict[str, Any]:
    import elastocal.plugins

    return {
        "elastocal": " ".join(sorted(ec.__all__)),
        "plugins": " ".join(sorted(elastocal.plugins.__all__)),
        "missing": [name for name in ec.__all__ if not hasattr(ec, name)],
    }


def model(folder: Path) -> dict[str, Any]:
    """A model, its table, and what its regressor says at the nominal parameters."""
    made = ec.Model("placed.toml")
    data = made.read("placed.csv")
    B = made.B(data)
    return {
        "names": " ".join(made.names),
        "nominal": made.nominal,
        "B": {"shape": B.shape, "column_norms": np.linalg.norm(B, axis=0)},
        "predict": made.predict(data),
        "table": {
            "rows": len(data),
            "markers": data.marker_names,
            "q": data.q,
            "force": data.force,
        },
        "frame": " ".join(data.to_dataframe().columns),
        "pose": made.pose([0.1, -1.2, 1.3, 0.2, 0.4, 0.5]),
        "repr": [repr(made), repr(data)],
    }


def identified(folder: Path) -> dict[str, Any]:
    fit = ec.identify("placed.toml", "placed.csv", fixed="joint2.compliance", test="june.csv")
    one = fit["joint3.offset"]
    fit.save("saved.json")
    again = ec.read_calibrated("placed.toml", "saved.json")
    return {
        "repr": [repr(fit), repr(fit.arm)],
        "one": {"name": one.name, "value": one.value, "unit": one.unit, "std": one.std,
                "ci95": one.ci95, "identifiable": one.identifiable, "note": one.note},
        "x": dict(zip(fit.model.names, fit.x, strict=True)),
        "noise": fit.noise.kind,
        "verdict": fit.verdict.to_json(),
        "findings": [f"{f.kind}: {f.severity}" for f in fit.findings],
        "rms": [fit.residual_rms, fit.heldout_rms, fit.nominal_rms, fit.dof, fit.converged],
        "test": fit.to_json()["test"],
        "frame": " ".join(fit.to_dataframe().columns),
        "keys": " ".join(sorted(fit.to_json())),
        "arm": {"values": again.values, "pose": again.pose([0.1, -1.2, 1.3, 0.2, 0.4, 0.5])},
    }  # fmt: skip


def diagnosed(folder: Path) -> dict[str, Any]:
    why = ec.diagnose(
        "placed.toml", "june.csv", false_alarm=0.1, without=["backlash", "frame_jump"]
    )
    return {
        "repr": repr(why),
        "verdict": why.verdict,
        "p_value": why.p_value,
        "probability_nothing": why.probability_nothing,
        "gap": {"nominal": why.gap.nominal, "calibrated": why.gap.calibrated},
        "budget": [{"step": step.step} for step in why.budget],
        "effects": [{"effect": e.effect, "where": e.where} for e in why.effects],
        "candidates": ", ".join(sorted(f"{c.effect}:{c.where}" for c in why.candidates)),
        "frame": " ".join(why.to_dataframe().columns),
        "findings": [f"{f.kind}: {f.severity}" for f in why.findings],
    }


def compensated(folder: Path) -> dict[str, Any]:
    """Commands for two positions and a whole pose, and what a compensation says of them."""
    arm = ec.read_calibrated("placed.toml", "placed.json")
    found = ec.compensate(
        arm, [[-1.8, 0.0, 0.9], [9.0, 0.0, 0.9]], load=[0, 0, -1000], point="M1", frame="tracker"
    )
    found.save("commands.csv") if all(found.reached) else None
    return {
        "repr": repr(found), "q": found.q, "nominal": found.nominal, "before": found.before,
        "after_below_1e-9": [bool(a < 1e-9) for a in found.after],
        "reached": found.reached, "warnings": found.warnings,
        "frame": " ".join(found.to_dataframe().columns),
    }  # fmt: skip


def compared(folder: Path) -> dict[str, Any]:
    january, june = (ec.read_calibrated("placed.toml", f"{n}.json") for n in ("placed", "june"))
    found = ec.compare(january, june, load=[0, 0, -1000])
    return {"repr": repr(found), "p": found.p, "level": found.level,
            "changed": [str(c.name) for c in found.changed],
            "frame": " ".join(found.to_dataframe().columns)}  # fmt: skip


def planned(folder: Path) -> dict[str, Any]:
    """A small plan at levels, by D: what it promises and how it reads."""
    plan = ec.design(
        "deflecting.toml", poses=3, criterion="D", candidates=40, effort="quick",
        loads=[[0, 0, -98]], levels={"joint2": np.radians([-30.0, 20.0, 60.0])},
    )  # fmt: skip
    return {"repr": repr(plan), "unit": plan.unit, "criterion": plan.criterion,
            "reported": plan.reported, "efficiency": plan.certificate.efficiency_pool,
            "frame": " ".join(plan.to_dataframe().columns),
            "keys": " ".join(sorted(plan.to_json()))}  # fmt: skip


def built_in_python(folder: Path) -> dict[str, Any]:
    """A cell made of objects, simulated and identified without a file of its own."""
    cell = ec.read_cell("placed.toml")
    made = ec.Model(cell)
    data = ec.simulate(made, made.read_plan("plan270.csv"), load=[0, 0, -1000], seed=3)
    fit = ec.identify(made, data, prior={"joint2.compliance": {"mean": 2.9e-7, "std": 1e-9}})
    return {"repr": [repr(cell)[:60], repr(data)],
            "parameters": [{"name": e.name, "value": e.value, "std": e.std}
                           for e in fit.estimates if e.identifiable],
            "prior_share": fit.prior_share}  # fmt: skip


def published(folder: Path) -> dict[str, Any]:
    """The estimators of Klimchik et al. 2013, on an equation system with a known answer."""
    from elastocal.identification import published as paper

    rng = np.random.default_rng(6)
    B = rng.normal(size=(60, 4))
    sigma = 10e-6 * (1 + np.arange(60) % 3)
    dp = B @ np.array([3e-4, -1e-4, 2e-4, 5e-5]) + sigma * rng.normal(size=60)
    group = np.arange(60) // 6
    fits = {
        "ols": paper.ols(B, dp),
        "ols_sigma": paper.ols(B, dp, sigma),
        "wls": paper.wls(B, dp, 1 / sigma),
        "wls_sigma": paper.wls(B, dp, np.ones(60), sigma),
        "eq14": paper.eq14(B, dp)[-1],
        "eq14_group": paper.eq14(B, dp, group)[-1],
        "eq14_first": paper.eq14(B, dp, group)[0],
    }
    return {
        name: {"method": fit.method, "x": fit.x, "std": fit.std, "covariance": fit.covariance,
               "weights": fit.weights, "residual": fit.residual}
        for name, fit in fits.items()
    } | {"weights": paper.eq14_weights(sigma)}  # fmt: skip


def told(folder: Path) -> dict[str, Any]:
    from support.diagnoses import VERDICTS

    return {f"text {name}": _printed(found) for name, found in VERDICTS.items()}


def _printed(result: Any) -> list[str]:
    return [line for line in str(result).splitlines() if line.strip()]
