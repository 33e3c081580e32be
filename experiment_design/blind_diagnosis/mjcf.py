"""The elastic arm as a MuJoCo model.

Every joint is two coaxial hinges: the drive, which is set, and a spring, which gives.  Other
springs (bearing tilt, bending of a link, pedestal) are further hinges or slides of the same body;
the balancing spring is a spatial tendon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from skeleton import Skeleton, transverse

Array = NDArray[np.float64]
GRAVITY = 9.80665  # m/s², along −z
# Rotor inertia, which statics does not see: coaxial hinges alone have a singular mass matrix.
ARMATURE = 'armature="1"'


@dataclass(frozen=True)
class Spring:
    """One elastic degree of freedom of a body: 0 the base, 1 … J the links, J + 1 the flange.

    It sits at the body's origin before the body's drive moves; compliance in rad/(N·m) or m/N.
    """

    body: int
    axis: Array
    compliance: float
    kind: Literal["hinge", "slide"] = "hinge"


@dataclass(frozen=True)
class Tendon:
    """A spring of stiffness N/m and free length m between two points in the plane of a joint.

    anchor (2,) m on the body before joint `joint` (0-based), along axes u, v fixed to it with
    u × v the joint axis; the moving end sits at −arm·u in the frame that the joint turns.
    """

    joint: int
    stiffness: float
    anchor: tuple[float, float]
    arm: float
    free_length: float


def mjcf(skeleton: Skeleton, springs: Sequence[Spring], tendon: Tendon | None) -> str:
    """MJCF of the arm: bodies base, link1 … linkJ, flange; joints driveJ and springH, from 0."""
    J = skeleton.n_joints
    # Own springs stand next to the drive; what bends before them comes first in the body.
    order = [*range(J, len(springs)), *range(J)]
    texts = []
    for body in range(J + 2):
        lines = [f'<body name="{_name(body, J)}">', _inertial(skeleton, body)]
        lines += [
            f'<joint name="spring{h}" type="{springs[h].kind}" axis="{_text(springs[h].axis)}" '
            f'stiffness="{1 / springs[h].compliance:.17g}" {ARMATURE}/>'
            for h in order
            if springs[h].body == body
        ]
        if 1 <= body <= J:
            axis = _text(skeleton.axis[body - 1])
            lines.append(f'<joint name="drive{body - 1}" type="hinge" axis="{axis}" {ARMATURE}/>')
        texts.append("\n".join(lines))
    sites, tendons = _tendon(skeleton, tendon)
    for body, site in sites.items():
        texts[body] += site
    return (
        '<mujoco><compiler angle="radian" inertiafromgeom="false"/>'
        f'<option gravity="0 0 {-GRAVITY}"/><worldbody>'
        + "\n".join(texts)
        + "</body>" * (J + 2)
        + f"</worldbody>{tendons}</mujoco>"
    )


def _inertial(skeleton: Skeleton, body: int) -> str:
    """A link's mass; base and flange weigh nothing that matters (a moving body needs a mass)."""
    if 1 <= body <= skeleton.n_joints:
        mass, com = skeleton.mass[body - 1], _text(skeleton.com[body - 1])
    else:
        mass, com = 1e-9, "0 0 0"
    return f'<inertial pos="{com}" mass="{mass:.17g}" diaginertia="{mass} {mass} {mass}"/>'


def _tendon(skeleton: Skeleton, tendon: Tendon | None) -> tuple[dict[int, str], str]:
    """Sites by body, and the <tendon> element."""
    if tendon is None:
        return {}, ""
    j = tendon.joint
    u, v = transverse(skeleton.axis[j])
    anchor = tendon.anchor[0] * u + tendon.anchor[1] * v
    fixed = skeleton.position[j] + skeleton.rotation[j] @ anchor
    sites = {
        j: f'<site name="anchor" pos="{_text(fixed)}"/>',
        j + 1: f'<site name="end" pos="{_text(-tendon.arm * u)}"/>',
    }
    return sites, (
        f'<tendon><spatial stiffness="{tendon.stiffness}" springlength="{tendon.free_length}">'
        '<site site="anchor"/><site site="end"/></spatial></tendon>'
    )


def _name(body: int, J: int) -> str:
    return "base" if body == 0 else "flange" if body == J + 1 else f"link{body}"


def _text(values: Array) -> str:
    return " ".join(f"{v:.17g}" for v in values)
