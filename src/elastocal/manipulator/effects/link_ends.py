"""Where each link ends, and whether it has a length."""

from __future__ import annotations

from elastocal.manipulator.chain import Array, Chain

SHORTEST = 1e-6  # m; a shorter link has neither a length to grow nor a direction of its own


def link_ends(chain: Chain) -> list[Array]:
    """Per link the placement (4, 4) of its distal frame in its joint's frame at zero motion.

    The distal frame is the next joint's, the flange's for the last link.
    """
    return [joint.placement for joint in chain.joints[1:]] + [chain.flange_placement]
