"""Small identifications to report on: a KR 270-2 with hostile marker names, and a clean one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.cells import MARKERS, kr270_cell, kr270_chain, random_poses, table_of

from elastocal.cell_tables import CartesianNoise, DesignSpec, Tracker
from elastocal.identification.identify import identify
from elastocal.identification.result import Calibration
from elastocal.identification.start import Method, Options
from elastocal.model.manipulator import Model
from elastocal.planning.design import DesignOptions, design
from elastocal.planning.plan import Plan
from elastocal.report import figures
from elastocal.simulation import simulate, values_from

EFFECTS = ("base_frame", "joint_offset", "joint_compliance", "marker_position")
SCRIPT = "<script>alert(1)</script>"
MARKUP = "[red]$x^2$ & \x1b[31m"
SIGMA = 3e-5


@dataclass(frozen=True)
class Case:
    """A result and the true values behind it."""

    result: Calibration
    truth: dict[str, float]


def make_case(
    names: tuple[str, ...] = ("M1", "M2"),
    effects: tuple[str, ...] = EFFECTS,
    poses: int = 8,
    faulty: int = 0,
    drop: bool = False,
    method: Method = "auto",
    shifted: slice | None = None,
) -> Case:
    """Readings with 30 µm noise of an arm whose base and joints are off by about 1 mm, 1 mrad."""
    cell = kr270_cell(effects)
    points = dict(zip(names, MARKERS.values(), strict=False))
    tool = replace(cell.tool)
    object.__setattr__(tool, "markers", points)  # names that no cell takes: pages escape them too
    cell = replace(cell, tool=tool, tracker=Tracker(noise=CartesianNoise(np.full(3, SIGMA))))
    model = Model.assembled(kr270_chain(), cell)
    rng = np.random.default_rng(7)
    table = table_of(
        random_poses(model.chain, poses, 3), np.array([0.0, 0.0, -2600.0]), names, both=True
    )
    truth = {
        p.name: float(p.nominal + 1e-3 * rng.normal())
        if p.effect in ("base_frame", "joint_offset")
        else float(p.nominal)
        for p in model.parameters
    }
    table = simulate(model, table, values_from(model, truth), rng, noise=False)
    position = np.asarray(table.position) + SIGMA * rng.normal(size=(len(table), 3))
    position[3 : 3 + 5 * faulty : 5] += 0.03
    if shifted is not None:
        position[shifted] += [4e-3, 1e-3, 0.0]
    options = Options(faulty="drop" if drop else "keep", method=method)
    return Case(identify(model, replace(table, position=position), options), truth)


@pytest.fixture(scope="session")
def case() -> Case:
    """Two markers; some parameters alone, some combined, absorbed, invisible."""
    return make_case(poses=12)


@pytest.fixture(scope="session")
def shifted() -> Case:
    """Six lines displaced by 4.1 mm across configurations, and left out as faulty."""
    return make_case(poses=12, drop=True, method="wls", shifted=slice(9, 15))


@pytest.fixture(scope="session")
def hostile() -> Case:
    effects = ("base_frame", "marker_position")
    return make_case((SCRIPT, MARKUP), effects, faulty=1, drop=True)


@pytest.fixture(scope="session")
def plan() -> Plan:
    """Four poses at two levels of joint 2; the first marker's name has markup."""
    loads = np.array([[0, 0, 0], [0, 0, -2600.0]])
    spec = DesignSpec(poses=4, loads=loads, candidates=30, levels={"joint2": (-0.5, -1.0)})
    cell = kr270_cell(["joint_compliance"], observe="deflection")
    markers = dict(zip([SCRIPT, "M2", "M3"], cell.tool.markers.values(), strict=True))
    noise = CartesianNoise(np.full(3, 1e-5))
    tracker = Tracker(np.array([3.0, 0.0, 1.0]), noise)
    cell = replace(cell, tool=replace(cell.tool, markers=markers), tracker=tracker, design=spec)
    return design(cell, DesignOptions(effort="quick"))


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without figures, for what does not depend on them: drawing takes its time."""
    monkeypatch.setattr(figures, "svg", lambda block: "<svg></svg>")
