"""An independent elastic arm: MuJoCo's kinematics, springs and weights, not ours.

Every joint of the chain is a hinge or slide with a spring of stiffness 1/k about its commanded
value.  At rest, with a dead force f (3,) at the load point and weights if `gravity` is given,

    r(δ) = k ∘ [ τ_spring(q, δ) − τ_bias(q + δ) + J(q + δ)ᵀ f ] = 0,      τ_spring = −δ / k

whose solution δ (n,) is the deflection.  The bracket is MuJoCo's own generalised force
(qfrc_passive − qfrc_bias + mj_applyFT); the factor k turns it into radians or metres, so that
soft and stiff joints are solved to the same accuracy.  Rigid joints (k = 0) do not move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from elastocal.errors import ElastocalError
from elastocal.model.chain import Chain, LinkMass
from elastocal.units import Array

NO_MASS = 1e-14  # kg, of a moving body: MuJoCo needs some
TOLERANCE = 1e-13  # last Newton step, rad or m
MAX_STEPS = 50
DIFFERENCE_STEP = 1e-6  # central differences of r, rad or m: relative error of the slope 1e-9


class MujocoArm:
    """The elastic arm of a chain in MuJoCo; the world is the base frame.

    compliance: (n,) joint compliances k in rad/(N·m), or m/N for prismatic joints, ≥ 0.
    load_point: (3,) m in the flange frame, where forces act.
    markers: name → (3,) m in the flange frame.
    masses: one LinkMass per joint, default the chain's own; they count where gravity is given.
    gravity: (3,) m/s² in the base frame, e.g. (0, 0, -9.80665); default none.
    """

    def __init__(
        self,
        chain: Chain,
        compliance: ArrayLike,
        load_point: ArrayLike = (0.0, 0.0, 0.0),
        markers: Mapping[str, ArrayLike] | None = None,
        masses: Sequence[LinkMass] | None = None,
        gravity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        self.compliance = np.array(compliance, dtype=float)
        self.marker_names = tuple(markers or {})
        sites = {f"marker {name}": place for name, place in (markers or {}).items()}
        text = _mjcf(chain, self.compliance, sites | {"load point": load_point},
                     chain.masses if masses is None else masses, gravity)  # fmt: skip
        self._model = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self._model)
        self._flange = self._model.body("flange").id
        self._elastic = np.flatnonzero(self.compliance > 0)

    def flange(self, q: ArrayLike) -> Array:
        """T_base_flange (4, 4) at joint values q (n,), springs or not."""
        self._move_to(np.array(q, dtype=float))
        T = np.eye(4)
        T[:3, :3] = self._data.xmat[self._flange].reshape(3, 3)
        T[:3, 3] = self._data.xpos[self._flange]
        return T

    def markers(self, q: ArrayLike) -> dict[str, Array]:
        """Marker positions (3,) in m in the base frame at joint values q (n,), by name.

        Where the arm gives way, hand in the deflected joint values of `equilibrium`.
        """
        self._move_to(np.array(q, dtype=float))
        return {name: self._data.site(f"marker {name}").xpos.copy() for name in self.marker_names}

    def equilibrium(self, q: ArrayLike, force: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Joint values (n,) at rest, commanded to q (n,), under `force` (3,) N at the load point.

        The force keeps its direction in the base frame while the arm gives way.
        Raises ElastocalError where no stable equilibrium is found.
        """
        q, force = np.array(q, dtype=float), np.array(force, dtype=float)
        self._model.qpos_spring[:] = q
        x, h = q.copy(), DIFFERENCE_STEP * np.eye(len(q))[self._elastic]
        for _ in range(MAX_STEPS):
            ahead, behind = ([self._residual(x + s * d, force) for d in h] for s in (1, -1))
            slope = (np.array(ahead) - behind).reshape(len(h), -1).T / (2 * DIFFERENCE_STEP)
            step = np.linalg.solve(slope, self._residual(x, force))
            x[self._elastic] -= step
            if not np.all(np.isfinite(x)):
                break
            if np.max(np.abs(step), initial=0.0) < TOLERANCE:
                # −∂r/∂δ = K⁻¹ (K − ∂τ/∂δ) has the signs of the symmetric total stiffness.
                if np.any(np.linalg.eigvals(-slope).real <= 0):
                    raise ElastocalError(
                        "the equilibrium is unstable: the load buckles the joints; "
                        "check compliances and load"
                    )
                return x
        raise ElastocalError(
            f"no static equilibrium near q = {q.tolist()} under {force.tolist()} N; "
            "check compliances and load"
        )

    def _move_to(self, q: Array) -> None:
        """Frames, passive forces and bias forces of MuJoCo at q, at rest."""
        self._data.qpos[:] = q
        self._data.qvel[:] = 0.0
        mujoco.mj_fwdPosition(self._model, self._data)
        mujoco.mj_fwdVelocity(self._model, self._data)

    def _residual(self, x: Array, force: Array) -> Array:
        """r (n_elastic,) in rad or m at joint values x (n,)."""
        self._move_to(x)
        data, load = self._data, np.zeros(self._model.nv)
        point = data.site("load point").xpos
        mujoco.mj_applyFT(self._model, data, force, np.zeros(3), point, self._flange, load)
        total = data.qfrc_passive - data.qfrc_bias + load
        return (self.compliance * total)[self._elastic]


def _mjcf(
    chain: Chain,
    compliance: Array,
    sites: Mapping[str, ArrayLike],
    masses: Sequence[LinkMass],
    gravity: ArrayLike,
) -> str:
    """One body per joint, each inside the one before, with its spring; sites at the flange."""
    text = "".join(f'<site name="{name}" pos="{_text(at)}"/>' for name, at in sites.items())
    text = _body("flange", chain.flange_placement, text)
    for i, joint in reversed(list(enumerate(chain.joints))):
        link = masses[i] if len(masses) else LinkMass(0.0, np.zeros(3))
        kind = "slide" if joint.kind == "prismatic" else "hinge"
        stiffness = 1.0 / float(compliance[i]) if compliance[i] > 0 else 0
        # The armature keeps the mass matrix regular; without motion it exerts no force.
        own = (
            f'<inertial pos="{_text(link.com)}" mass="{max(float(link.mass), NO_MASS)!r}" '
            f'diaginertia="1e-12 1e-12 1e-12"/><joint type="{kind}" axis="{_text(joint.axis)}" '
            f'stiffness="{stiffness!r}" armature="1"/>'
        )
        text = _body(f"link{i + 1}", joint.placement, own + text)
    return (
        f'<mujoco><compiler angle="radian"/><option gravity="{_text(gravity)}"/>'
        f"<worldbody>{text}</worldbody></mujoco>"
    )


def _body(name: str, T: Array, inside: str) -> str:
    """A body at T (4, 4) in the frame of its parent."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return (
        f'<body name="{name}" pos="{_text(T[:3, 3])}" quat="{_text((w, x, y, z))}">{inside}</body>'
    )


def _text(values: ArrayLike) -> str:
    """Numbers separated by blanks, each with the digits that give the same double back."""
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=float))
