"""Is an arm that the verdict trusts at X µm as good as that where nobody measured?

elastocal study experiment_design/verdict [--set campaigns=400]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.cell_tables import (
    CartesianNoise,
    EffectChoice,
    ModelSpec,
    Robot,
    Tool,
    Tracker,
)
from elastocal.identification.identify import identify
from elastocal.identification.least_squares import rms_3d
from elastocal.measurements import Measurements
from elastocal.messages import ElastocalError
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.model.urdf import read_urdf
from elastocal.simulation import expand_plan, simulate

ARM_FILES = Path(__file__).parent.parent / "blind_diagnosis" / "arms"
ARMS = {
    "KR 270": (Path(str(files("elastocal.demo") / "kr270_2.urdf")), 2600.0),
    "medium": (ARM_FILES / "medium.urdf", 150.0),
    "heavy": (ARM_FILES / "heavy.urdf", 1500.0),
    "seven axes": (ARM_FILES / "seven_axis.urdf", 100.0),
}  # with the load in N
MODELS = {
    "geometry": ("base_frame", "joint_offset", "link_geometry", "marker_position"),
    "geometry and springs": (
        "base_frame", "joint_offset", "link_geometry", "marker_position", "joint_compliance",
    ),
    "springs": ("joint_compliance",),
}  # fmt: skip
HIDDEN = ("none", "none", "none", "backlash", "gear_eccentricity", "joint scatter")
SAG = 1e-3  # m, what each joint of a typical arm yields under the load at full reach
TEST_POSES = 200
NUMBERS = (
    "at_um", "true_um", "heldout_um", "predicted_um", "from_um", "own_um", "open_um", "lacking_um",
)  # fmt: skip
ALLOWED = 1.25  # the true error over what the verdict says


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for number in range(options["campaigns"]):
        yield {"number": number}


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """What the verdict says of a campaign, and what is true; `rng` is not used."""
    model, table, exact, kind = campaign(task["number"])
    unknown = dict.fromkeys(NUMBERS, np.nan)
    row: dict[str, Any] = kind | {"refused": "", "tone": "", "missing": ""} | unknown
    try:
        fit = identify(model, table)
    except ElastocalError as error:
        return row | {"refused": str(error)[:200]}
    new = observe(exact, fit.model.observe)
    true = rms_3d(fit.model.predict(exact, fit.x, new) - new.value, new.size) * 1e6
    verdict, found = fit.verdict.to_json(), fit.predicted
    if found is not None:
        low = found.ci95[0]
        parts = (found.rms, low, found.parameters, found.open, found.lacking or 0.0)
        row |= dict(zip(NUMBERS[3:], (1e6 * v for v in parts), strict=True))
    return row | {
        "tone": verdict["tone"], "at_um": verdict["at_um"],
        "missing": ",".join(verdict["missing"]), "true_um": true,
        "heldout_um": fit.heldout_rms * 1e6,
    }  # fmt: skip


def summary(frame: pd.DataFrame) -> str:
    """The table of the README."""
    judged = frame[frame["refused"] == ""].copy()
    judged["worse"] = judged["true_um"] / judged["at_um"]
    lines = ["| verdict | campaigns | true error below 1.25 X | true error / X, median | 95 % |",
             "|---|---|---|---|---|"]  # fmt: skip
    for tone, name in (("good", "trusted at X"), ("care", "with care"), ("poor", "not to be used")):
        some = judged[judged["tone"] == tone]["worse"].dropna()
        if len(some):
            share = f"{100 * (some < ALLOWED).mean():.1f} % ({int((some < ALLOWED).sum())})"
            lines.append(
                f"| {name} | {len(some)} | {share} | {some.median():.2f} | "
                f"{some.quantile(0.95):.2f} |"
            )
    return "\n".join(lines)


# --- campaigns: arms, sizes, plans, and effects that the model does not have ---------------------


def campaign(number: int) -> tuple[Model, Measurements, Measurements, dict[str, Any]]:
    """What is fitted (model and table) in the campaign of that number, what is true at new poses,
    and of what kind it is; everything about it follows from the number."""
    rng = np.random.default_rng([21, number])
    arm, what = rng.choice(list(ARMS)), rng.choice(list(MODELS))
    path, weight = ARMS[arm]
    chain = read_urdf(path)
    hidden = str(rng.choice(HIDDEN))
    scale, size = float(rng.choice([0.3, 1.0])), float(np.exp(rng.uniform(np.log(0.3), np.log(3))))
    sigma, stated = float(rng.choice([10e-6, 30e-6])), bool(rng.random() < 0.8)
    poses, markers = int(np.exp(rng.uniform(np.log(6), np.log(60)))), int(rng.choice([1, 3]))
    share, repeats = float(rng.choice([0.25, 0.6, 1.0])), int(rng.choice([1, 3]))
    joint = f"joint{rng.integers(1, chain.n_joints + 1)}"
    fitted = _model(chain, MODELS[what], what, markers, sigma if stated else None)
    added = (EffectChoice(hidden, joint),) if hidden in ("backlash", "gear_eccentricity") else ()
    real = fitted.with_effects(fitted.cell.model.effects + added)
    x = _true(real, rng, scale, size, weight)
    low, high = _limits(chain)
    middle = low + rng.uniform(share / 2, 1 - share / 2, len(low)) * (high - low)
    near = middle + share / 2 * (high - low) * rng.uniform(-1, 1, (poses, len(low)))
    load = None if what == "geometry" else np.array([0.0, 0.0, -weight])
    rows = _rows(real, near, load, repeats)
    table = _measured(real, rows, x, rng, sigma, 20e-6 * size * (hidden == "joint scatter"))
    far = rng.uniform(low, high, (TEST_POSES, len(low)))
    exact = simulate(real, _rows(real, far, load, 1), x, rng, False)
    kind = {
        "arm": str(arm), "model": str(what), "hidden": hidden, "size": size, "scale": scale,
        "sigma_um": sigma * 1e6, "stated": "yes" if stated else "no",
        "poses": poses, "markers": markers,
        "range": share, "repeats": repeats,
    }  # fmt: skip
    return fitted, table, exact, kind


def _limits(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    limits = np.clip([(j.lower, j.upper) for j in chain.joints], -np.pi, np.pi)
    return limits[:, 0], limits[:, 1]


def _model(
    chain: Chain, effects: tuple[str, ...], what: str, markers: int, sigma: float | None
) -> Model:
    places = {"M1": [0.20, 0.0, 0.05], "M2": [-0.1, 0.2, 0.1], "M3": [0.0, -0.1, 0.2]}
    chosen = {name: np.array(place) for name, place in list(places.items())[:markers]}
    observe = "deflection" if what == "springs" else "position"
    spec = ModelSpec(observe=observe, effects=effects)
    tracker = Tracker(noise=None if sigma is None else CartesianNoise(np.full(3, sigma)))
    low, high = _limits(chain)
    cell = Cell("campaign", None, Robot(), Tool(np.array([0.1, 0.0, 0.1]), chosen), tracker, spec)
    limits = {f"joint{i + 1}": (low[i], high[i]) for i in range(len(low))}
    return Model.assembled(chain, replace(cell, limits=limits))


def _true(
    model: Model, rng: np.random.Generator, scale: float, size: float, weight: float
) -> np.ndarray:
    """Values (parameters,) of a real arm: geometry by `scale` typical sizes, a hidden effect by
    `size` of them."""
    x = model.nominal.copy()
    reach = sum(np.linalg.norm(j.placement[:3, 3]) for j in model.chain.joints)
    for i, p in enumerate(model.parameters):
        if p.effect == "joint_compliance":
            wrist = 4.0 if p.where in ("joint4", "joint5", "joint6", "joint7") else 1.0
            x[i] = wrist * SAG / (weight * reach**2) * rng.uniform(0.5, 2.0)
        elif p.effect == "backlash":
            x[i] = size * (p.typical or 0.0)
        elif p.effect == "base_frame":
            x[i] = 0.0
        elif p.effect == "gear_eccentricity":
            x[i] = size * (p.typical or 0.0) * rng.normal()
        else:
            x[i] += scale * (p.typical or 0.0) * rng.normal()
    if "base.x" in model.names:
        base = [model.names.index(f"base.{k}") for k in ("x", "y", "z", "rx", "ry", "rz")]
        x[base] = [*rng.uniform(-2, 2, 3), *Rotation.random(random_state=rng).as_rotvec()]
    return x


def _rows(model: Model, q: np.ndarray, load: np.ndarray | None, repeats: int) -> Measurements:
    plan = Measurements.of_poses("simulated", q, np.zeros(3))
    rows = expand_plan(plan, tuple(model.cell.tool.markers), repeats, load)
    return replace(rows, move=None, direction=None)


def _measured(
    model: Model, rows: Measurements, x: np.ndarray, rng: np.random.Generator, sigma: float,
    scatter: float,
) -> Measurements:  # fmt: skip
    """Noisy readings; the joints settle anew at each visit, by `scatter` rad."""
    moved = rows
    if scatter:
        keys = np.column_stack([rows.configuration, rows.repeat, rows.force])
        visit = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        off = scatter * rng.normal(size=(visit.max() + 1, rows.q.shape[1]))
        moved = replace(rows, q=rows.q + off[visit])
    exact = simulate(model, moved, x, rng, False).position
    return replace(rows, position=exact + sigma * rng.normal(size=exact.shape))
