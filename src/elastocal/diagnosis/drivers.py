"""What may drive an unknown effect: angles, time, torque, load, direction, force, view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.hypotheses import recorded
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

WAVES, FEW_WAVES = 8, 3  # functions of a smooth dependence, and of one in a product


@dataclass(frozen=True)
class Driver:
    """Smooth functions (C, v, f) of what a visit was like; `values` (C, v) in `unit` where they
    are functions of one number.  Where `joint` is given, no other joint is moved."""

    kind: str
    name: str
    functions: Array
    values: Array | None = None
    unit: str = ""
    joint: int | None = None


@dataclass(frozen=True)
class Drivers:
    """Drivers by visit (C, v, …) of a scene."""

    scene: Scene
    angle: Array
    torque: Array
    time: Array | None
    temperature: Array | None
    approach: Array | None
    load: Array | None

    @classmethod
    def of(cls, scene: Scene) -> Drivers:
        table, seen, places = scene.base.seen.table, scene.base.seen, scene.places

        def visits(values: Array) -> Array:
            return places.gather(values[seen.lead])

        def if_recorded(name: str) -> Array | None:
            return visits(getattr(table, name)) if recorded(table, name) else None

        force = np.linalg.norm(table.force, axis=1)
        return cls(
            scene, visits(table.q), visits(scene.columns.torques()), if_recorded("time"),
            if_recorded("temperature"), if_recorded("approach"),
            visits(force / force.max()) if recorded(table, "load") else None,
        )  # fmt: skip

    def smooth(self) -> Iterator[Driver]:
        """Every driver that is one number per visit, and every product of two."""
        yield from self._single()
        yield from self._with_load()
        yield from self._with_approach()
        yield from self._at_own_joint()
        if self.time is not None:
            time = waves(self.time, self.scene.present, FEW_WAVES)
            for i in range(self.n):
                both = _product(self._angle(i, FEW_WAVES), time)
                yield Driver("time × angle", f"time × joint{i + 1} angle", both)

    @property
    def n(self) -> int:
        return self.angle.shape[2]

    def _angle(self, i: int, count: int) -> Array:
        return waves(self.angle[:, :, i], self.scene.present, count)

    def _loaded_joints(self) -> list[int]:
        return [i for i in range(self.n) if np.ptp(self.torque[:, :, i][self.scene.present]) > 0]

    def _single(self) -> Iterator[Driver]:
        present = self.scene.present
        for i in range(self.n):
            angle = self.angle[:, :, i]
            yield Driver("angle", f"joint{i + 1} angle", self._angle(i, WAVES), angle, "rad")
        for i in self._loaded_joints():
            tau = self.torque[:, :, i]
            functions = _odd_and_even(tau, present)
            yield Driver("torque", f"joint{i + 1} torque", functions, tau, "N m")
        if self.time is not None:
            yield Driver("time", "time", waves(self.time, present, WAVES), self.time, "s")
        if self.temperature is not None:
            warmth = waves(self.temperature, present, FEW_WAVES)
            yield Driver("temperature", "temperature", warmth, self.temperature, "°C")

    def _with_load(self) -> Iterator[Driver]:
        load, present = self.load, self.scene.present
        if load is None:
            return
        levels = len(np.unique(load[present].round(6)))
        powers = [load] if levels < 3 else [load, load**2]
        both = np.stack(powers, axis=2) * present[:, :, None]
        yield Driver("load", "load", both, load, "of the largest load")
        for i in range(self.n):
            few = self._angle(i, FEW_WAVES) * load[:, :, None]
            yield Driver("load × angle", f"load × joint{i + 1} angle", few)
        if self.time is not None:
            time = waves(self.time, present, FEW_WAVES)
            yield Driver("load × time", "load × time", time * load[:, :, None])

    def _with_approach(self) -> Iterator[Driver]:
        if self.approach is None:
            return
        for i in range(self.n):
            a = self.approach[:, :, i]
            by = [a] if self.load is None else [a, a * self.load]
            torque = np.abs(self.torque[:, :, i])
            if torque.max() > 0:
                by.append(a * torque / torque.max())
            functions = np.stack(by, axis=2)
            yield Driver("approach", f"approach of joint{i + 1}", functions, joint=i)

    def _at_own_joint(self) -> Iterator[Driver]:
        """A stiffness that changes with the joint's own angle, or with time."""
        present = self.scene.present
        for i in self._loaded_joints():
            tau = self.torque[:, :, i] / np.abs(self.torque[:, :, i][present]).max()
            name = f"joint{i + 1} torque"
            by_angle = self._angle(i, WAVES - FEW_WAVES) * tau[:, :, None]
            yield Driver("torque × angle", f"{name} × its angle", by_angle, joint=i)
            if self.time is not None:
                by_time = waves(self.time, present, FEW_WAVES) * tau[:, :, None]
                yield Driver("torque × time", f"{name} × time", by_time, joint=i)

    def wrenches(self) -> Iterator[tuple[Array, Array]]:
        """The load's force and moment (C, v, 3) at each link's end along its axes, largest 1.

        A link's end moved by e moves every marker by R e, so the columns of its frame are R; and
        turned about e they move a marker by R e × lever, whose product with the force is the
        moment about e, the load taken at the marker.
        """
        scene = self.scene
        if self.load is None:
            return
        table, lead = scene.base.seen.table, scene.base.seen.lead
        for k in range(self.angle.shape[2]):
            E = scene.columns.entry(("link_frame", (f"link{k + 1}",)))
            if E.shape[1] < 3:
                return
            wrench = np.einsum("nsd,ns->nd", E[:, :3], table.force)
            wrench = scene.places.gather(wrench[lead])
            force, moment = wrench[:, :, :3], wrench[:, :, 3:]
            yield force / max(np.abs(force).max(), 1e-12), moment / max(np.abs(moment).max(), 1e-12)

    def view(self) -> Array:
        """Unit vector (n_rows, 3) from each marker to the instrument, in the flange frame."""
        base = self.scene.base
        table = base.seen.table
        T = base.model.flange_poses(table, base.x)
        assert table.position is not None
        line = base.model.cell.tracker.position - table.position
        line = line / np.linalg.norm(line, axis=1, keepdims=True)
        return np.einsum("nij,ni->nj", T[:, :3, :3], line)


def waves(x: Array, present: NDArray[np.bool_], count: int) -> Array:
    """cos(kπu)/k, k = 1 … count, of x (C, v) scaled to u in [0, 1]: (C, v, count).

    The fall with k makes a Gaussian prior over their weights one over continuous functions.
    """
    known = x[present]
    span = max(float(np.ptp(known)), 1e-12)
    u = (x - known.min()) / span
    k = np.arange(1, count + 1)
    return np.cos(np.pi * u[:, :, None] * k) / k * present[:, :, None]


def _product(a: Array, b: Array) -> Array:
    """Products of the functions a (C, v, f) and b (C, v, g): (C, v, f·g)."""
    return np.asarray((a[:, :, :, None] * b[:, :, None, :]).reshape(*a.shape[:2], -1))


def monomials(x: Array, degree: int) -> Array:
    """Products of the components of x (n, 3) up to `degree`, without the constant."""
    out = [x[:, [i]] for i in range(x.shape[1])]
    if degree > 1:
        out += [x[:, [i]] * x[:, [j]] for i in range(x.shape[1]) for j in range(i + 1)]
    return np.concatenate(out, axis=1)


def _odd_and_even(x: Array, present: NDArray[np.bool_]) -> Array:
    """x, x³, sign and size of a torque, x scaled to its largest."""
    u = x / max(float(np.abs(x[present]).max()), 1e-12)
    functions = np.stack([u, u**3, np.tanh(u / 0.05), np.abs(u), u**2], axis=2)
    return functions * present[:, :, None]
