"""The shape of a dependence that has no name: the motion as a function of what drives it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.result import Curve
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

MOST_CURVES = 3
UNITS = {1: ("rad",), 3: ("m",) * 3, 6: ("m",) * 3 + ("rad",) * 3}
AXES = {1: ("",), 3: (" x", " y", " z"), 6: (" x", " y", " z", " rx", " ry", " rz")}


def curves_of(scene: Scene, chosen: ModelSet) -> tuple[Curve, ...]:
    """Curves of the unknown blocks that depend on one number, the largest components first."""
    at = chosen.at
    out: list[Curve] = []
    for item, span in zip(chosen.items, chosen.spans, strict=True):
        block = item.what
        if isinstance(block, Hypothesis) or block.source is None or block.source.values is None:
            continue
        assert block.drive is not None and block.entry is not None
        there = scene.present
        x = block.source.values[there]
        motion = block.drive[there] @ at.beta[span]  # (visits, d)
        half = block.drive[there] @ at.beta_deviation.T[span]
        deviation = np.linalg.norm(half, axis=2)
        _, order = np.unique(x, return_index=True)
        d = motion.shape[1]
        largest = np.argsort(-(motion.std(axis=0) / deviation.mean(axis=0)))
        for k in largest[: min(d, MOST_CURVES)]:
            y = motion[order, k]
            out.append(
                Curve(
                    block.driver,
                    block.source.unit,
                    f"{block.where}{AXES[d][k]}",
                    UNITS[d][k],
                    _numbers(x[order]),
                    _numbers(y - y.mean()),
                    _numbers(deviation[order, k]),
                )
            )
    return tuple(out)


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
