"""The elastic arm as a MuJoCo model, and where it comes to rest under load and weight.

Every joint is two coaxial hinges: the drive, which is set, and a spring, which gives.  Other
springs (bearing tilt, bending of a link, pedestal) are further hinges or slides of the same body;
the balancing spring is a spatial tendon.

At rest, with MuJoCo's generalised forces,

    r = θ − θ_free(τ) − k τ = 0,      τ = qfrc_applied + qfrc_passive − qfrc_bias + θ / k,

θ (H,) the springs' deflections, τ (H,) the load on each, k (H,) its compliance, and θ_free the
deflection at which its spring is slack: wind-up, play, hardening.  |∂(k τ)/∂θ| is below 0.05 in any
arm that can hold its load, so θ ← θ_free + k τ converges by more than a digit per step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation
from skeleton import Array, Skeleton, transverse

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


TOLERANCE = 1e-12  # largest |r|, rad (m for a slide)
MAX_STEPS = 100
PROBE = 1e-6  # rad, to find how a joint's load changes with its own angle


@dataclass(frozen=True)
class Placement:
    """Where every body's frame stands before its joints move, for each of n visits.

    position (n, J+2, 3) m, rotation (n, J+2, 3, 3): base in the world, links, flange.
    """

    position: Array
    rotation: Array


@dataclass(frozen=True)
class Rest:
    """Static equilibria: flange position (n, 3) and rotation (n, 3, 3) in the world, load of each
    spring (n, H) N·m, and the largest residual |r| in rad."""

    position: Array
    rotation: Array
    load: Array
    residual: float


class ElasticArm:
    """The arm with `springs`; the first J are the joints' own, about their axes."""

    def __init__(
        self, skeleton: Skeleton, springs: Sequence[Spring], tendon: Tendon | None = None
    ) -> None:
        self.compliance = np.array([s.compliance for s in springs])
        self._model = mujoco.MjModel.from_xml_string(mjcf(skeleton, springs, tendon))
        self._data = mujoco.MjData(self._model)
        adr = self._model.jnt_qposadr
        J = skeleton.n_joints
        self._drive = np.array([adr[self._model.joint(f"drive{j}").id] for j in range(J)])
        self._spring = np.array(
            [adr[self._model.joint(f"spring{h}").id] for h in range(len(springs))]
        )
        self._flange = self._model.body("flange").id

    def rest(
        self,
        drive: Array,
        placement: Placement,
        force: Array,
        hook: Array,
        slack: Callable[[Array], Array],
        play: dict[int, float],
    ) -> Rest:
        """Equilibria at drive angles (n, J) with force (n, 3) N at hook (n, 3) m of the flange.

        slack(τ) (n, H) → θ_free (n, H); play: spring → width β of its dead zone in rad.  Within
        the dead zone the joint carries nothing: φ ∈ [−β/2, β/2] with τ = 0 inside, τ ≥ 0 at +β/2
        and τ ≤ 0 at −β/2, the fixed points of φ ← clip(φ + τ/c).  With c the change of τ per
        angle this is Newton's method inside the zone.
        """
        n, H = len(drive), len(self.compliance)
        theta, floating = np.zeros((n, H)), np.zeros((n, H))
        rate = {h: self._own_rate(h, drive, placement, force, hook) for h in play}
        for _ in range(MAX_STEPS):
            load, position, rotation = self._loads(theta, drive, placement, force, hook)
            for h, width in play.items():
                moved = floating[:, h] + load[:, h] / rate[h]
                floating[:, h] = np.clip(moved, -width / 2, width / 2)
            wanted = slack(load) + floating + self.compliance * load
            residual = float(np.abs(theta - wanted).max())
            if residual < TOLERANCE:
                return Rest(position, rotation, load, residual)
            theta = wanted
        raise RuntimeError(f"no equilibrium: residual {residual:g} rad after {MAX_STEPS} steps")

    def _own_rate(
        self, h: int, drive: Array, placement: Placement, force: Array, hook: Array
    ) -> Array:
        """|∂τ_h/∂θ_h| (n,) of the unbent arm, away from zero."""
        theta = np.zeros((len(drive), len(self.compliance)))
        before = self._loads(theta, drive, placement, force, hook)[0][:, h]
        theta[:, h] = PROBE
        after = self._loads(theta, drive, placement, force, hook)[0][:, h]
        return np.maximum(np.abs(after - before) / PROBE, 1e-6 / self.compliance[h])

    def _loads(
        self, theta: Array, drive: Array, placement: Placement, force: Array, hook: Array
    ) -> tuple[Array, Array, Array]:
        """Load on each spring (n, H), flange position (n, 3) and rotation (n, 3, 3)."""
        m, d = self._model, self._data
        n = len(theta)
        quaternion = Rotation.from_matrix(placement.rotation.reshape(-1, 3, 3)).as_quat()
        quaternion = quaternion[:, [3, 0, 1, 2]].reshape(n, -1, 4)
        load, position = np.empty_like(theta), np.empty((n, 3))
        rotation, applied, torque = np.empty((n, 9)), np.zeros(m.nv), np.zeros(3)
        for i in range(n):
            m.body_pos[1:], m.body_quat[1:] = placement.position[i], quaternion[i]
            d.qpos[self._drive], d.qpos[self._spring] = drive[i], theta[i]
            mujoco.mj_fwdPosition(m, d)
            mujoco.mj_fwdVelocity(m, d)
            position[i], rotation[i] = d.xpos[self._flange], d.xmat[self._flange]
            point = position[i] + rotation[i].reshape(3, 3) @ hook[i]
            applied[:] = 0.0
            mujoco.mj_applyFT(m, d, force[i], torque, point, self._flange, applied)
            load[i] = (applied + d.qfrc_passive - d.qfrc_bias)[self._spring]
        return load + theta / self.compliance, position, rotation.reshape(n, 3, 3)
