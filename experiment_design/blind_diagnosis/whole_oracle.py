"""What can be known of a whole arm: by one who knows its structure, and of what its gap consists.

The oracle fits, by penalised least squares about the truth, exactly the columns that the arm has:
geometry, lines at their true orders, sag by unknown moments, compliances, half widths with the
true directions, the creep as a Gaussian process of its true length.  Every parameter has the
prior it was drawn from (mean and standard deviation), readings the tracker's true noise and the
joints' true scatter.  With r the noise of the readings, X the columns, D the prior deviations and
β* the truth, its error at other poses is X' (β̂ − β*), where β̂ minimises
|r − X (β − β*)|²_V⁻¹ + |D⁻¹ (β − β₀)|².
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from arm_data import ANGLE, BASE_ANGLE, BASE_POSITION, COMPLIANCE_SPREAD, LENGTH, MARKER, OFFSET
from draw import World
from instrument import polar
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from skeleton import Array
from whole_columns import Scene, components, moments, scene_of
from whole_draw import CREEP, LAST_MOVE, LINES, RANGES, WEIGHTS, creep
from world import Effect, Visits

SHOWN = 1e-4  # singular value of unit columns, of the largest
SMALLEST = 1e-10  # of the creep's largest variance: what is below is left out


@dataclass(frozen=True)
class Block:
    """Parameters of one kind: columns (n, K, p); standard deviation (p,) of the prior, and how far
    the truth (p,) is from its mean."""

    columns: Array
    deviation: Array
    away: Array


@dataclass(frozen=True)
class Sights:
    """A world's campaign, its first `n` visits, and its other poses, with the columns of the true
    arm at both."""

    world: World
    n: int
    visits: Visits
    scene: Scene

    @classmethod
    def of(cls, world: World) -> Sights:
        visits = world.visits.then(world.fresh())
        return cls(world, len(world.visits.q), visits, scene_of(world, visits))


def second_moment(bounds: tuple[float, float]) -> float:
    """E x² of a log-uniform x."""
    low, high = bounds
    return (high**2 - low**2) / (2 * np.log(high / low))


def oracle_errors(sights: Sights) -> tuple[float, float]:
    """Rms length (m) of the oracle's errors at the other poses, and that which its posterior
    covariance lets expect."""
    blocks = [*geometry(sights), *effects(sights)]
    X = np.concatenate([b.columns * b.deviation for b in blocks], axis=2)
    X, other = X[: sights.n], X[sights.n :]
    away = np.concatenate([b.away / b.deviation for b in blocks])
    world = sights.world
    truth = world.noise_free(world.visits)
    r = (world.readings() - truth).reshape(len(truth), -1)
    root = np.linalg.cholesky(covariance(sights, truth))
    X, r = np.linalg.solve(root, X), np.linalg.solve(root, r[:, :, None])
    X, other = (x.reshape(-1, x.shape[2]) for x in (X, other))
    # |r − X u|² + |u + away|², in units of the priors.
    factor = cho_factor(X.T @ X + np.eye(X.shape[1]))
    u = cho_solve(factor, X.T @ r.ravel() - away)
    variance = (other.T * cho_solve(factor, other.T)).sum() / len(other)
    return rms_length(other @ u), float(np.sqrt(3 * variance))


def oracle_error(sights: Sights) -> float:
    """Rms length (m) of the oracle's errors at the other poses."""
    return oracle_errors(sights)[0]


def rms_length(error: Array) -> float:
    """Rms length of the markers' errors (…,) whose last 3 M coordinates are those of a visit."""
    return float(np.sqrt((error.reshape(-1, 3) ** 2).sum(axis=1).mean()))


def covariance(sights: Sights, points: Array) -> Array:
    """That of a visit's K coordinates, (n, K, K): the tracker's noise and the joints' scatter."""
    noise, joint = sights.world.noise, sights.scene.joint[: sights.n]
    K = joint.shape[1]
    scatter = joint * noise.repeatability
    V = scatter @ scatter.transpose(0, 2, 1)
    along, sigma = polar(points), noise.sigma(points)
    each = np.einsum("nmka,nmk,nmkb->nmab", along, sigma**2, along)
    for m in range(K // 3):
        V[:, 3 * m : 3 * m + 3, 3 * m : 3 * m + 3] += each[:, m]
    return V


def geometry(sights: Sights) -> Iterator[Block]:
    """Base, offsets, links, markers and compliances, about what their owner believes."""
    world, at = sights.world, sights.scene
    true, spec, believed = world.specimen.true, world.spec, world.specimen
    J = spec.skeleton.n_joints
    yaw = Rotation.from_euler("z", believed.base_yaw_deg, degrees=True)
    turn = (Rotation.from_matrix(true.base_rotation) * yaw.inv()).as_rotvec()
    away = np.concatenate([true.base_position - believed.base_position, turn])
    yield Block(at.base, np.repeat([BASE_POSITION, BASE_ANGLE], 3), away)
    yield Block(at.joint, np.full(J, OFFSET), true.offset)
    moved = []
    for j in range(J):
        R = spec.skeleton.rotation[j + 1].T
        turned = Rotation.from_matrix(R @ true.skeleton.rotation[j + 1]).as_rotvec()
        moved += [R @ (true.skeleton.position[j + 1] - spec.skeleton.position[j + 1]), turned]
    sizes = np.tile(np.repeat([LENGTH, ANGLE], 3), J)
    yield Block(at.links, sizes, np.concatenate(moved))
    off = (true.markers - np.array(spec.markers)).ravel()
    yield Block(at.markers, np.full(len(off), MARKER), off)
    k = believed.compliance
    yield Block(
        at.joint * at.load[:, None], COMPLIANCE_SPREAD / np.sqrt(3) * k, true.compliance - k
    )


def effects(sights: Sights) -> Iterator[Block]:
    """What is wrong beside geometry and compliances, by the laws that it has."""
    world, v, at = sights.world, sights.visits, sights.scene
    spec, true = world.spec, world.specimen.true
    for e in world.effects:
        if e.name == LINES:
            for line, order in e.settings.items():
                angle = order * v.q[:, e.index]
                waves = np.stack([np.sin(angle), np.cos(angle)], axis=1)
                columns = at.joint[:, :, e.index, None] * waves[:, None]
                size = spec.gear * line_deviation(line)
                yield Block(columns, np.full(2, size), e.vector(f"{line}_sin", f"{line}_cos"))
        elif e.name == LAST_MOVE:
            columns = at.joint[:, :, [e.index]] * v.approach[:, None, [e.index]]
            size = spec.gear * np.sqrt(second_moment(RANGES.half_width))
            yield Block(columns, np.array([size]), e.vector("half_width"))
        elif e.name == WEIGHTS:
            columns = np.einsum("nkj,j,njp->nkp", at.joint, true.compliance, at.weighing)
            yield Block(columns, _moment_deviations(world), moments(e))
        elif e.name == CREEP:
            yield _creep(sights, e)


def line_deviation(line: str) -> float:
    """Standard deviation of the sine of a heavy arm's line: half of the mean squared amplitude."""
    if line == "eccentricity":
        return float(np.sqrt(second_moment(RANGES.eccentricity) / 2))
    low, high = RANGES.next_line
    shrinks = (low**2 + low * high + high**2) / 3
    power = second_moment(RANGES.line) * shrinks ** (int(line.removeprefix("line")) - 1)
    return float(np.sqrt(power / 2))


def _moment_deviations(world: World) -> Array:
    """About zero: nobody has told the masses.  (4 J,) kg, kg·m."""
    skeleton = world.spec.skeleton
    scale = np.sqrt(second_moment(RANGES.mass))
    away = np.sqrt((skeleton.com**2).mean(axis=1) + (RANGES.centre * world.spec.reach) ** 2)
    mass = scale * skeleton.mass
    return np.column_stack([mass, *[mass * away] * 3]).ravel()


def _creep(sights: Sights, e: Effect) -> Block:
    """The base's motion at all times, in the axes of its prior covariance."""
    time, base = sights.visits.time, sights.scene.base
    apart = (time[:, None] - time) / e.settings["length_s"]
    value, axes = np.linalg.eigh(np.exp(-0.5 * apart**2))
    kept = value > SMALLEST * value.max()
    basis = axes[:, kept]
    sizes = [np.sqrt(second_moment(b)) for b in (RANGES.shift, RANGES.turn)]
    deviation = np.repeat(sizes, 3)[:, None] * np.sqrt(value[kept])
    columns = np.einsum("nkb,np->nkbp", base, basis).reshape(*base.shape[:2], -1)
    return Block(columns, deviation.ravel(), (creep(e, time).T @ basis).ravel())


@dataclass(frozen=True)
class Gap:
    """What geometry leaves of the effects at the campaign's readings: family and place of each
    part, mean products (C, C) m² of what they move, and the rms of a coordinate
    of the whole in m."""

    parts: tuple[tuple[str, str], ...]
    products: Array
    rms: float

    def strength(self, parts: Sequence[tuple[str, str]]) -> float:
        """Mean square of what these parts do together, over that of the whole: never negative."""
        at = [self.parts.index(p) for p in parts]
        return float(self.products[np.ix_(at, at)].sum() / self.rms**2)


def gap_of(sights: Sights) -> Gap:
    """Each part's motion without what the fitted geometry takes on of it, by least squares."""
    n, scene = sights.n, sights.scene
    parts = components(sights.world, sights.visits, scene)
    moved = np.stack([part[:n].ravel() for part in parts.values()], axis=1)
    # The cell's model knows no weights: its compliances answer to the payload.
    *frames, springs = geometry(sights)
    springs = replace(springs, columns=scene.joint * scene.carried[:, None])
    X = np.concatenate([b.columns[:n] * b.deviation for b in (*frames, springs)], axis=2)
    X = X.reshape(len(moved), -1)
    # Axes that are all but parallel in this one arm show nothing: no fit would follow there.
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    left = moved - X @ np.linalg.lstsq(X, moved, rcond=SHOWN)[0]
    products = left.T @ left / len(left)
    return Gap(tuple(parts), products, float(np.sqrt(products.sum())))
