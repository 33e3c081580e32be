"""I-optimality: the prediction variance integrated over a region."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.trace import TraceCriterion


def prediction_variance(A: Array) -> TraceCriterion:
    """`I`: Φ = (1/T) Σ_t tr(A_t V A_tᵀ), V = M⁻¹, in m²: the mean over a region's T points.

    A (S, T, r, p) in m per scaled parameter: what is predicted at point t, as r components.
    `reported`: √Φ in µm, the root mean square error of prediction.  With the test poses as region
    it is `test_pose` with equal weights.
    Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (I- and V-optimality).
    """
    C = np.einsum("stri,strj->sij", A, A, optimize=True) / A.shape[1]
    return TraceCriterion(C, "I", scale=1e6, unit="µm")
