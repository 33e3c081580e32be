"""Joints that yield under the links' own weights, where nobody knows the weights.

Joint j's torque from weights is linear in the bodies' masses m_k and first moments s_k,

    τ_j = −g Σ_{k ≥ j} [m_k ∂(u·o_k)/∂q_j + Σ_c s_kc ∂(u·R_k e_c)/∂q_j],

with o_k and R_k the origin and axes of link k's frame and u the vertical, and with a compliance it
is a deflection of the same form in the unknown products of compliance, mass and g.  Most of these
functions depend on each other: what two joints about parallel axes carry, masses on an axis.  A
largest independent set of them is chosen once for a chain (QR with column pivoting; Golub and Van
Loan, Matrix Computations, section 5.4), numerically, as base inertial parameters are (Gautier
1991, J. Robotic Systems 8, 485).

Where the model has the joints' compliances the same weights make all joints yield, and what is
unknown are the arm's moments alone.  For all joints together the independent ones have a closed
form: a mass at the origin of link k's frame stands on link k − 1, and of a first moment the part
along a joint's axis does not turn with it, so that

    V = g u · [Σ_turning R_k (x_k S_kx + y_k S_ky) + Σ_sliding R_k a_k M_k q_k],

x_k, y_k across the axis a_k of joint k, with all that stands further out counted in: M_k is the
mass that joint k carries, and S_k the first moment of link k with it at the link's end.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from scipy.linalg import qr

from elastocal.cell.work_cell import Cell
from elastocal.model import rigid
from elastocal.model.arm import Arm, ParameterSpec, Setting
from elastocal.model.chain import Chain, Joint, finite_ranges
from elastocal.model.effects.base import REVOLUTE, Effect, Symbols, index, links
from elastocal.model.effects.compliances import transverse_axes
from elastocal.model.effects.driven import DrivenEffect, JointMotion
from elastocal.model.effects.loads import STANDARD_GRAVITY
from elastocal.model.effects.placements import link_ends
from elastocal.units import Array

POSES = 400  # random ones, in which the functions are compared
LEVELLED = 0.1  # share of a weight's torque that an axis feels which stands 6° off the vertical
DEPENDENT = 1e-8  # of the largest; what is left of a function that others make up


def weight_torques(chain: Chain, q: ca.SX, up: ca.SX, j: int) -> ca.SX:
    """−∂(height)/∂q_j of joint j (0-based) for each function that its links' weights bring.

    For each link k ≥ j four: the height of its frame's origin in m, and those of the ends of its
    three unit axes.  `q` (joints,) are symbols, `up` (3,) is the vertical in the base frame.
    """
    T, heights = ca.SX.eye(4), []
    for k, joint in enumerate(chain.joints):
        motion = rigid.joint_motion(joint.kind, joint.axis, q[k])
        T = T @ rigid.constant(joint.placement) @ motion
        if k >= j:
            heights += [ca.dot(up, T[:3, 3]), *ca.vertsplit(T[:3, :3].T @ up)]
    return -ca.jacobian(ca.vertcat(*heights), q)[:, j]


Shape = tuple[tuple, ...]


def _shape(chain: Chain) -> Shape:
    """What of a chain decides its torques."""
    return tuple(
        (joint.kind, joint.placement.tobytes(), tuple(map(float, joint.axis)),
         float(joint.lower), float(joint.upper))
        for joint in chain.joints
    )  # fmt: skip


def independent(chain: Chain, j: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Which of `weight_torques` of joint j (0-based) make up all of them, and their rms over the
    joints' ranges and all directions of the vertical."""
    return _independent(_shape(chain), j)


@lru_cache(maxsize=256)
def _independent(shape: Shape, j: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    values = _torques(shape, j, None)
    R, pivot = qr(values, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    chosen = np.sort(pivot[: int((diagonal > DEPENDENT * diagonal[0]).sum())])
    rms = np.sqrt((values[:, chosen] ** 2).mean(axis=0))
    return tuple(map(int, chosen)), tuple(map(float, rms))


@lru_cache(maxsize=256)
def carried(shape: Shape, j: int, up: tuple[float, ...]) -> float:
    """Rms torque of weights on joint j with the vertical `up` in the base frame, over that of all
    directions of the vertical."""
    upright, anyhow = (float((_torques(shape, j, of) ** 2).mean()) for of in (up, None))
    return float(np.sqrt(upright / anyhow)) if anyhow else 0.0


def _torques(shape: Shape, j: int, up: tuple[float, ...] | None) -> Array:
    """`weight_torques` of joint j (POSES, functions) in random poses under one vertical, or under
    as many random ones."""
    joints = tuple(
        Joint("", kind, np.frombuffer(placement).reshape(4, 4), np.array(axis), lower, upper)
        for kind, placement, axis, lower, upper in shape
    )
    chain = Chain("", joints, np.eye(4))
    q, height = ca.SX.sym("q", len(joints)), ca.SX.sym("height", 3)
    torques = ca.Function("torques", [q, height], [weight_torques(chain, q, height, j)])
    rng = np.random.default_rng(0)
    limits = np.array([[joint.lower, joint.upper] for joint in joints]).T
    at = rng.uniform(*finite_ranges(chain, *limits), (POSES, len(joints)))
    upward = rng.normal(size=(POSES, 3)) if up is None else np.tile(up, (POSES, 1))
    upward /= np.linalg.norm(upward, axis=1, keepdims=True)
    values: Array = torques.map(POSES)(at.T, upward.T).full().T
    return values


class GravitySag(DrivenEffect):
    """δq_j = Σ_i a_i φ_i(q), φ_i the torques of unknown weights about joint j; a_i in rad.

    φ_i are −∂(height)/∂q_j of points on the links that the joint carries, as many as are
    independent of each other, at the commanded joints, each divided by its rms over the joints'
    ranges: so a_i is how far the joint gives way on average.  The vertical is z of the tracker
    frame, seen from the base wherever that stands.  It needs no masses: a_i is compliance times
    g times a sum of masses and first moments.  Setting: the prior size `sag_size_rad` of each a_i.
    Where compliances are known, `link_weights` says more with less, and so does `link_gravity`
    where masses are.
    """

    name = "gravity_sag"
    stage = "transmission"
    at = "turning joints"
    constants = (Setting("sag_size_rad", "range", 2e-4, 1e-12, 1.0),)
    together = True
    family = "gravity"
    sized_by = "sag_size_rad"
    entry = JointMotion()

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        size = self.stated(place, chain, cell)[self.sized_by]
        return tuple(
            ParameterSpec(f"sag_{k + 1}", "rad", 0.0, size, shrunk=True)
            for k in range(len(independent(chain, index(place))[0]))
        )

    def acts(self, place: str, chain: Chain, cell: Cell) -> bool:
        turned = cell.model.nominal.base_rotation
        up = (0.0, 0.0, 1.0) if turned is None else tuple(np.asarray(turned)[2].tolist())
        return carried(_shape(chain), index(place), up) > LEVELLED

    def drive(self, arm: Arm, place: str, p: Symbols) -> ca.SX:
        chosen, rms = independent(arm.chain, index(place))
        up = arm.T_tracker_base[2, :3].T
        torques = weight_torques(arm.chain, arm.q_commanded, up, index(place))
        terms = (
            p[f"sag_{k + 1}"] * torques[i] / r
            for k, (i, r) in enumerate(zip(chosen, rms, strict=True))
        )
        return sum(terms, ca.SX(0))


# Kilograms of an arm of one metre: arms of 0.6 to 1.4 m weigh 15 to 40 kg per square metre of their
# reach, and heavy ones twice as much.
WEIGHT = 30.0  # kg/m²
HOUSING = 0.1  # m, that even the last link stands out


def extents(chain: Chain) -> tuple[list[Array], Array]:
    """The way (3,) in m from each joint to its link's end, and the stretched length (joints,) of
    what follows there, a housing at least."""
    ends = [T[:3, 3] for T in link_ends(chain)]
    lengths = np.array([np.linalg.norm(end) for end in ends])
    return ends, np.cumsum(lengths[::-1])[::-1] - lengths + HOUSING


class LinkWeights(Effect):
    """V = g u · [Σ R_k (x_k S_kx + y_k S_ky) + Σ R_k a_k M_k q_k]: weights of all links at once.

    S_kx, S_ky (kg m) is the first moment of link k across its joint's axis, with the mass of all
    that follows at the link's end; of a sliding joint M_k (kg) is the mass that it carries.  These
    make up the torques of any masses about all joints, which then yield by their compliances: so
    it shows where the cell has `joint_compliance` or other springs, and `gravity_sag` is what can
    be had elsewhere.  With `link_gravity` they are what is missing from the masses stated.  Each is
    as large as where everything weighs `weights_kg_per_m` (setting, the prior size): along the way
    to the link's end, half of the link and all that follows; across it, the link a housing away.
    """

    name = "link_weights"
    stage = "load"
    at = "arm"
    together = True
    family = "gravity"
    sized_by = "weights_kg_per_m"

    def settings(self, place: str, chain: Chain, cell: Cell) -> tuple[Setting, ...]:
        ends, further = extents(chain)
        density = WEIGHT * float(np.linalg.norm(ends[0]) + further[0])
        return (Setting(self.sized_by, "range", density, 1e-9, 1e9),)

    def parameters(self, place: str, chain: Chain, cell: Cell) -> tuple[ParameterSpec, ...]:
        density = self.stated(place, chain, cell)[self.sized_by]
        found: list[ParameterSpec] = []
        described = zip(links(chain), chain.joints, *extents(chain), strict=True)
        for link, joint, end, further in described:
            own, across = float(np.linalg.norm(end)), np.array(transverse_axes(joint.axis))
            mass = density * (own + HOUSING)
            if joint.kind == REVOLUTE:
                for key, way in zip("xy", np.abs(across @ end).tolist(), strict=True):
                    along, across_it = density * way * (own / 2 + further), mass * HOUSING
                    name, size = f"{link}_moment_{key}", along + across_it
                    alike = "along" if along > across_it else "across"
                    found.append(ParameterSpec(name, "kg*m", 0.0, size, shrunk=True, alike=alike))
            else:
                size = density * (own + further)
                found.append(ParameterSpec(f"{link}_mass", "kg", 0.0, size, shrunk=True))
        return tuple(found)

    def load(self, arm: Arm, place: str, p: Symbols) -> None:
        moment = ca.SX(0)
        for i, (link, joint) in enumerate(zip(links(arm.chain), arm.chain.joints, strict=True)):
            up = arm.T_tracker_link[i][2, :3]
            if joint.kind == REVOLUTE:
                for key, axis in zip("xy", transverse_axes(joint.axis), strict=True):
                    moment += p[f"{link}_moment_{key}"] * (up @ rigid.constant(axis))
            else:
                along = up @ rigid.constant(joint.axis)
                moment += p[f"{link}_mass"] * along * arm.joint_angle(i)
        arm.add_potential(STANDARD_GRAVITY * moment)
