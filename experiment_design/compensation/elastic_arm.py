"""An independent elastic arm: MuJoCo's kinematics, springs and weights, not ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from elastocal.errors import ElastocalError
from elastocal.model.chain import Chain, LinkMass
from elastocal.units import Array

# A chain as MJCF: what MuJoCo needs to move, bend and weigh it.

# A moving body needs some mass and inertia in MuJoCo; these weigh 1e-13 N.
NO_MASS, NO_INERTIA = 1e-14, 1e-12


def write_mjcf(
    chain: Chain,
    compliance: Array,
    sites: Mapping[str, Array],
    masses: Sequence[LinkMass],
    gravity: Array,
) -> str:
    """MJCF text of the chain in the base frame.

    One body per joint, each inside the one before, with a spring of stiffness 1/k (none where
    k = 0); `sites`: name → (3,) m in the flange frame; masses as in Chain; gravity (3,) m/s².
    """
    root = ET.Element("mujoco", model="elastic arm")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=numbers(gravity))
    parent = ET.SubElement(root, "worldbody")
    for i, (joint, k) in enumerate(zip(chain.joints, compliance, strict=True)):
        parent = ET.SubElement(parent, "body", placed_body(f"link{i + 1}", joint.placement))
        body = masses[i] if masses else LinkMass(0.0, np.zeros(3))
        ET.SubElement(
            parent,
            "inertial",
            pos=numbers(body.com),
            mass=repr(max(float(body.mass), NO_MASS)),
            diaginertia=numbers([NO_INERTIA] * 3),
        )
        ET.SubElement(
            parent,
            "joint",
            name=f"joint{i + 1}",
            type="slide" if joint.kind == "prismatic" else "hinge",
            axis=numbers(joint.axis),
            stiffness=repr(1.0 / float(k)) if k > 0 else "0",
            armature="1",  # keeps the mass matrix regular; without motion it exerts no force
        )
    flange = ET.SubElement(parent, "body", placed_body("flange", chain.flange_placement))
    for name, position in sites.items():
        ET.SubElement(flange, "site", name=name, pos=numbers(position))
    return ET.tostring(root, encoding="unicode")


def placed_body(name: str, T: Array) -> dict[str, str]:
    """Attributes of a body or site called `name` at T (4, 4) in the frame of its parent."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"name": name, "pos": numbers(T[:3, 3]), "quat": numbers((w, x, y, z))}


def numbers(values: ArrayLike) -> str:
    """Numbers separated by blanks, each with the digits that give the same double back."""
    return " ".join(repr(float(value)) for value in np.asarray(values, dtype=float))


# An independent elastic arm: MuJoCo's kinematics, springs and weights, not ours.
#
# Every joint of the chain is a hinge or slide with a spring of stiffness 1/k about its commanded
# value.  At rest, with a dead force f (3,) at the load point and weights if `gravity` is given,
#
#     r(δ) = k ∘ [ τ_spring(q, δ) − τ_bias(q + δ) + J(q + δ)ᵀ f ] = 0,      τ_spring = −δ / k
#
# whose solution δ (n,) is the deflection.  The bracket is MuJoCo's own generalised force
# (qfrc_passive − qfrc_bias + mj_applyFT); the factor k turns it into radians or metres, so that
# soft and stiff joints are solved to the same accuracy.  Rigid joints (k = 0) do not move.

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
        gravity: ArrayLike | None = None,
    ) -> None:
        import mujoco

        self._mujoco = mujoco
        self.compliance = np.array(compliance, dtype=float)
        self.masses = tuple(chain.masses if masses is None else masses)
        self.marker_names = tuple(markers or {})
        sites = {"load point": np.array(load_point)}
        for name, position in (markers or {}).items():
            sites[f"marker {name}"] = np.array(position)
        g = np.zeros(3) if gravity is None else np.array(gravity)
        self.mjcf = write_mjcf(chain, self.compliance, sites, self.masses, g)
        self._model = self._mujoco.MjModel.from_xml_string(self.mjcf)
        self._data = self._mujoco.MjData(self._model)
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
        delta = np.zeros(len(self._elastic))
        for _ in range(MAX_STEPS):
            slope = self._slope(q, delta, force)
            step = np.linalg.solve(slope, self._residual(q, delta, force))
            delta = delta - step
            if not np.all(np.isfinite(delta)):
                break
            if np.max(np.abs(step), initial=0.0) < TOLERANCE:
                self._check_stable(slope)
                return self._deflected(q, delta)
        raise ElastocalError(
            f"no static equilibrium near q = {q.tolist()} under {force.tolist()} N; "
            "check compliances and load"
        )

    def _deflected(self, q: Array, delta: Array) -> Array:
        deflected = q.copy()
        deflected[self._elastic] += delta
        return deflected

    def _move_to(self, q: Array) -> None:
        """Frames, passive forces and bias forces of MuJoCo at q, at rest."""
        self._data.qpos[:] = q
        self._data.qvel[:] = 0.0
        self._mujoco.mj_fwdPosition(self._model, self._data)
        self._mujoco.mj_fwdVelocity(self._model, self._data)

    def _residual(self, q: Array, delta: Array, force: Array) -> Array:
        """r(δ) (n_elastic,) in rad or m."""
        self._move_to(self._deflected(q, delta))
        load = np.zeros(self._model.nv)
        point = self._data.site("load point").xpos
        self._mujoco.mj_applyFT(
            self._model, self._data, force, np.zeros(3), point, self._flange, load
        )
        total = self._data.qfrc_passive - self._data.qfrc_bias + load
        return (self.compliance * total)[self._elastic]

    def _slope(self, q: Array, delta: Array, force: Array) -> Array:
        """∂r/∂δ (n_elastic, n_elastic) by central differences."""
        slope = np.empty((len(delta), len(delta)))
        for j in range(len(delta)):
            h = np.zeros(len(delta))
            h[j] = DIFFERENCE_STEP
            ahead, behind = (self._residual(q, delta + s * h, force) for s in (1, -1))
            slope[:, j] = (ahead - behind) / (2 * DIFFERENCE_STEP)
        return slope

    def _check_stable(self, slope: Array) -> None:
        # −∂r/∂δ = K⁻¹ (K − ∂τ/∂δ) has the signs of the symmetric total stiffness K − ∂τ/∂δ.
        if np.any(np.linalg.eigvals(-slope).real <= 0):
            raise ElastocalError(
                "the equilibrium is unstable: the load buckles the joints; "
                "check compliances and load"
            )
