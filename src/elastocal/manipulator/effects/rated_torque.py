"""How large the torque on a joint gets: the scale of everything that follows it."""

from __future__ import annotations

import numpy as np

from elastocal.cell import Cell
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.effects.joint_compliance import nominal_compliance
from elastocal.manipulator.effects.link_ends import link_ends
from elastocal.manipulator.effects.link_gravity import STANDARD_GRAVITY

RATED_WIND_UP = 3e-3  # rad; what a drive yields by at its largest torque, small or large
WRIST_SHARE = 1 / 8  # of the strongest joint's torque, in common six- and seven-axis arms
UNRATED = 1e3  # N m, where nothing tells


def weight_torque(chain: Chain, i: int) -> float:
    """Bound in N m on the torque of the links' weights about revolute joint i (0-based).

    τ ≤ g Σ_j m_j r_j over the bodies j that the joint carries, r_j the length of the chain from
    the joint's axis to the body's centre of mass; whatever the pose and the mounting.  0 where
    masses are unknown.
    """
    axis = chain.joints[i].axis
    ends = [T[:3, 3] for T in link_ends(chain)]

    def off_axis(point: Array) -> float:
        return float(np.linalg.norm(np.cross(axis, point)))

    moment, reach = 0.0, 0.0
    for j, body in enumerate(chain.masses[i:], start=i):
        # Only the joint's own link keeps its direction to the axis in every pose.
        length = off_axis if j == i else np.linalg.norm
        moment += body.mass * (reach + float(length(body.com)))
        reach += float(length(ends[j]))
    return STANDARD_GRAVITY * moment


def rated_torque(chain: Chain, cell: Cell, i: int) -> float | None:
    """Size in N m of the largest torque on revolute joint i (0-based); None where nothing tells.

    The largest of the weights' torque on it, an eighth of that on the strongest joint, and the
    torque that winds the joint up by 3 mrad with its nominal compliance: payloads, which the cell
    does not state, load a wrist far more than its own weight does.
    """
    given = nominal_compliance(chain, cell)
    wound = RATED_WIND_UP / given[i] if given and given[i] > 0 else 0.0
    turning = [j for j, kind in enumerate(chain.kinds) if kind == "revolute"]
    strongest = max(weight_torque(chain, j) for j in turning)
    return max(weight_torque(chain, i), WRIST_SHARE * strongest, wound) or None


def torque_scale(chain: Chain, cell: Cell, i: int) -> float:
    """τ_s in N m: torques below it are so small that friction and play blur their sign.

    A thousandth of the rated torque: a true dead zone turns over at once, and a wrist seldom sees
    more than a few per cent of its rating.
    """
    return 1e-3 * (rated_torque(chain, cell, i) or UNRATED)
