"""A-optimality: the mean variance of the parameters."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import IntArray
from elastocal.design.criteria.trace import TraceCriterion


def parameter_variance(interest: IntArray, parameters: int, scenarios: int) -> TraceCriterion:
    """`A`: Φ = tr V_II, V = M⁻¹: the summed variance of the k scaled parameters `interest`.

    `reported`: √(Φ/k), their root mean square standard deviation, in typical sizes of the
    parameters.  It depends on these sizes, unlike D and `test_pose`.
    Source: Pukelsheim 2006, ch. 6; Atkinson, Donev & Tobias 2007, ch. 10.
    """
    C = np.zeros((scenarios, parameters, parameters))
    C[:, interest, interest] = 1.0
    return TraceCriterion(C, "A", scale=len(interest) ** -0.5, unit="typical sizes")
