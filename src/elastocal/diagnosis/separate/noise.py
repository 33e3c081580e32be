"""The noise that a diagnosis found, and the readings that it left out, in the campaign's terms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.noise import SMALLEST, NoiseValues
from elastocal.diagnosis.result import Diagnosis


def noise_found(diagnosis: Diagnosis) -> NoiseValues:
    """Factor, repeatability (joints,) and shared scatter."""
    found = diagnosis.noise
    joint = np.maximum(found.repeatability, SMALLEST)
    return NoiseValues(found.stated_factor, joint, found.shared)


def left_out(base: Baseline, diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """Which observations (N,) of the base, planned ones included, are faulty readings."""
    lines = [f.line for f in diagnosis.noise.faulty]
    return np.isin(base.seen.table.row[base.seen.lead], lines)
