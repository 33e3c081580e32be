"""The work cell as the user describes it: TOML → frozen dataclasses (DESIGN: cell file)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from elastocal.cell_design import DesignSpec
from elastocal.cell_workspace import Workspace

Array = NDArray[np.float64]
Observe = Literal["position", "deflection", "pose", "distance"]


@dataclass(frozen=True)
class Robot:
    """A URDF with the names of its first and last link, or a DH table with its convention.

    `masses`: the table of link masses of a DH robot.  Files as absolute or relative paths.
    """

    urdf: Path | None = None
    base: str | None = None
    flange: str | None = None
    dh: Path | None = None
    dh_convention: Literal["standard", "modified"] = "standard"
    masses: Path | None = None


@dataclass(frozen=True)
class Tool:
    """`load_point` (3,) and `markers` name → (3,), in m in the flange frame."""

    load_point: Array = field(default_factory=lambda: np.zeros(3))
    markers: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class CartesianNoise:
    """Standard deviations (3,) in m along x, y, z of the tracker frame."""

    sigma: Array


@dataclass(frozen=True)
class PolarNoise:
    """Range and transverse standard deviation: constant part in m, part per metre of range (1)."""

    range: float
    range_per_m: float
    transverse: float
    transverse_per_m: float


@dataclass(frozen=True)
class Tracker:
    """`position` (3,) m: where the instrument stands in the frame of the data.

    `anchor` (3,) m: nominal cable or ball-bar anchor for distances.
    `rotation_sigma` rad and `distance_sigma` m: noise of pose and distance readings, if known.
    """

    position: Array = field(default_factory=lambda: np.zeros(3))
    noise: CartesianNoise | PolarNoise | None = None
    anchor: Array | None = None
    rotation_sigma: float | None = None
    distance_sigma: float | None = None


@dataclass(frozen=True)
class EffectChoice:
    """One entry of `effects`: "joint_compliance", or "joint_compliance:joint2" for one place."""

    name: str
    where: str | None = None


@dataclass(frozen=True)
class Nominal:
    """Nominal values and start hints; compliances in rad/(N m), base rotation (3, 3).

    `settings`: place → key → value of the constants that effects do not fit, in the key's unit.
    """

    joint_compliance: tuple[float, ...] | None = None
    base_position: Array | None = None
    base_rotation: Array | None = None
    gravity_compensator: dict[str, Any] | None = None
    settings: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelSpec:
    """What is observed, which effects are fitted, and what drives and settles the springs."""

    observe: Observe = "position"
    effects: tuple[EffectChoice, ...] = ()
    torque: Literal["computed", "measured"] = "computed"
    link_gravity: bool = False
    deflection_model: Literal["equilibrium", "linear"] = "equilibrium"
    compliance_levels: dict[str, tuple[float, ...]] = field(default_factory=dict)
    gear_ripple_orders: tuple[float, ...] = ()
    thermal_driver: Literal["time", "temperature"] = "time"
    play_side: Literal["load", "load_and_approach"] = "load"
    nominal: Nominal = field(default_factory=Nominal)


@dataclass(frozen=True)
class Cell:
    """Everything known about arm, tool, tracker and model before measuring.

    `plugins`: files, relative to `path`, and modules that register effects of the user's own.
    """

    name: str
    path: Path | None
    robot: Robot
    tool: Tool = field(default_factory=Tool)
    tracker: Tracker = field(default_factory=Tracker)
    model: ModelSpec = field(default_factory=ModelSpec)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    workspace: Workspace = field(default_factory=Workspace)
    design: DesignSpec = field(default_factory=DesignSpec)
    plugins: tuple[str, ...] = ()
