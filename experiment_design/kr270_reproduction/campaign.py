"""One simulated campaign of the paper: Table 2's poses, Table 1's noise, Table 3's compliances."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from elastocal.cell import read_cell
from elastocal.measurements import read_measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.simulation import (
    LOAD_N,
    REPEATS,
    expand_plan,
    published_compliances,
    reading_sigma,
    simulate,
    values_from,
)

DEMO = Path(str(files("elastocal.demo")))


@dataclass(frozen=True)
class Campaign:
    """Linearised at the truth: B (810, 9), exact deflections (810,), σ (810,) in m.

    `group` (810,) numbers configuration × direction, `configuration` (810,) 0 to 14; `position`
    (270, 3) m: where the markers stand when loaded, in the robot's frame.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    B: np.ndarray
    exact: np.ndarray
    sigma: np.ndarray
    group: np.ndarray
    configuration: np.ndarray
    position: np.ndarray

    def draw(self, seed: list[int], configuration_effect: float = 0.0) -> np.ndarray:
        """Δp (810,) less what B does not explain: B·truth + noise, eq. (4).

        `configuration_effect` in m: standard deviation of an error common to the 18 readings of
        a configuration in a direction.
        """
        rng = np.random.default_rng(seed)
        noise = self.sigma * rng.normal(size=len(self.sigma))
        common = configuration_effect * rng.normal(size=self.group.max() + 1)
        return self.B @ self.truth + noise + common[self.group]


def campaign() -> Campaign:
    """The campaign at the true equilibrium; joint 1, which the load cannot show, is left out."""
    cell = read_cell(DEMO / "cell.toml")
    model = Model(cell)
    plan = read_measurements(DEMO / "plan.csv", joint_kinds=model.chain.kinds, observe="plan")
    rows = expand_plan(plan, tuple(cell.tool.markers), REPEATS, np.array(LOAD_N))
    named, _ = published_compliances(DEMO)
    x = values_from(model, named)
    table = simulate(model, rows, x, 0, noise=False)
    at = model.regressor(table, x)
    visible = np.flatnonzero(np.linalg.norm(at.B, axis=0) > 1e-6 * np.linalg.norm(at.B))
    observed = observe(table, "deflection")
    configuration = np.repeat(observed.configuration, 3)
    direction = np.tile(np.arange(3), len(observed.lead))
    deflection_sigma = reading_sigma(DEMO) * np.sqrt(2)
    return Campaign(
        names=tuple(model.names[i] for i in visible),
        truth=x[visible],
        B=at.B[:, visible],
        exact=at.prediction,
        sigma=deflection_sigma[configuration, direction],
        group=configuration * 3 + direction,
        configuration=configuration,
        position=model.target_poses(rows.take(np.any(rows.force != 0, axis=1)), x)[1],
    )
