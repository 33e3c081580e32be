"""The three arms of the check, and one true specimen of an arm drawn about its nominal data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from skeleton import Array, Skeleton, read_skeleton
from world import TrueArm

FOLDER = Path(__file__).resolve().parent / "arms"

# Standard deviations of a specimen about its nominal data: what a first calibration removes.
OFFSET, LENGTH, ANGLE, MARKER = 5e-4, 3e-4, 3e-4, 5e-4  # rad, m, rad, m
BASE_POSITION, BASE_ANGLE = 2e-3, 2e-3  # m, rad
COMPLIANCE_SPREAD = 0.2  # uniform, either way


@dataclass(frozen=True)
class ArmSpec:
    """An arm as its data sheet has it: compliance (J,) rad/(N·m), payload N, points in m in the
    flange frame; `stand` m: how high the tracker's horizon lies above the base.

    gear: angular errors of its drives over those of a heavy arm's cycloidal gears (strain-wave
    gears of light arms err about twice as much).  expansion: strain at 8 K, of steel or aluminium.
    """

    name: str
    payload: float
    compliance: tuple[float, ...]
    markers: tuple[tuple[float, float, float], ...]
    hook: tuple[float, float, float]
    reach: float
    stand: float
    gear: float
    expansion: float
    has_compensator: bool = False

    @property
    def urdf(self) -> Path:
        return FOLDER / f"{self.name}.urdf"

    @cached_property
    def skeleton(self) -> Skeleton:
        return read_skeleton(self.urdf)

    @property
    def marker_names(self) -> tuple[str, ...]:
        return tuple(f"M{k + 1}" for k in range(len(self.markers)))


ARMS = {
    spec.name: spec
    for spec in (
        ArmSpec(
            "heavy", 2500.0, (3.4e-7, 2.9e-7, 4.1e-7, 2.9e-6, 3.2e-6, 2.2e-6),
            ((0.16, 0.0, 0.36), (-0.1, 0.13, 0.31), (-0.08, -0.15, 0.44)),
            (0.03, 0.0, 0.35), 2.8, 0.9, 1.0, 1e-4, has_compensator=True,
        ),
        ArmSpec(
            "medium", 100.0, (1.1e-5, 1.2e-5, 1.7e-5, 6.0e-5, 5.5e-5, 8.0e-5),
            ((0.11, 0.0, 0.07), (-0.06, 0.09, 0.05), (-0.05, -0.1, 0.12)),
            (0.015, 0.0, 0.14), 1.3, 0.5, 2.0, 2e-4,
        ),
        ArmSpec(
            "seven_axis", 120.0, (1.3e-5, 1.4e-5, 1.8e-5, 2.0e-5, 4.0e-5, 5.0e-5, 6.0e-5),
            ((0.1, 0.0, 0.06), (-0.05, 0.08, 0.05), (-0.06, -0.09, 0.11)),
            (0.012, 0.0, 0.13), 0.95, 0.4, 2.0, 2e-4,
        ),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Specimen:
    """One arm on its stand: the true one, and what its owner believes of base and compliances."""

    true: TrueArm
    base_position: Array
    base_yaw_deg: float
    compliance: Array


def draw_specimen(spec: ArmSpec, rng: np.random.Generator) -> Specimen:
    """Geometry, offsets, markers, base and compliances off nominal by what is usual."""
    J, azimuth = spec.skeleton.n_joints, rng.uniform(-np.pi, np.pi)
    distance = spec.reach + rng.uniform(1.2, 1.8)
    believed = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), -spec.stand])
    believed = believed.round(2)
    yaw = float(np.round(rng.uniform(-60.0, 60.0)))
    turn = Rotation.from_rotvec(rng.normal(0.0, BASE_ANGLE, 3))
    k = np.array(spec.compliance)
    k = k * rng.uniform(1 - COMPLIANCE_SPREAD, 1 + COMPLIANCE_SPREAD, J)
    true = TrueArm(
        skeleton=spec.skeleton.bent(
            rng.normal(0.0, LENGTH, (J, 3)), rng.normal(0.0, ANGLE, (J, 3))
        ),
        compliance=k,
        offset=rng.normal(0.0, OFFSET, J),
        base_position=believed + rng.normal(0.0, BASE_POSITION, 3),
        base_rotation=(turn * Rotation.from_euler("z", yaw, degrees=True)).as_matrix(),
        markers=np.array(spec.markers) + rng.normal(0.0, MARKER, (len(spec.markers), 3)),
        marker_names=spec.marker_names,
        hook=np.array(spec.hook),
    )
    return Specimen(true, believed, yaw, np.array(spec.compliance))
