"""Dependences without a name: a smooth motion of any place, driven by anything that was recorded.

Each block is one driver at one place of the chain: joint i's angle moves joint k or frame k; time,
torque, load and approach direction move joints, frames, markers; the load's force and moment
give way at a link; a field over the workspace or a marker's angle of view moves the reading; and
products of load with time, angle and direction.  Where a block explains the residual better than
every effect of the catalogue, the effect is unknown and the block is its location.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.columns import EntryKey
from elastocal.diagnosis.drivers import FEW_WAVES, Driver, Drivers, monomials
from elastocal.diagnosis.scene import Scene
from elastocal.manipulator.effects.base import Stage

Array = NDArray[np.float64]

# Prior sizes of an entry's components at the largest of a smooth dependence.
MOTION = {"rad": 1e-4, "m": 1e-4, "1": 1e-4}
BASE_MOTION = 5e-5
FRAME_WAVES = 5
HOOK_MOTION = 1e-2


@dataclass(frozen=True)
class Generic:
    """A block: `entry` moved by smooth functions of `driver`, or ready columns.

    `drive` (C, v, d, k) holds the functions for each component that moves; `columns` (C, m, k)
    are packed columns of blocks that vary within a visit.
    """

    kind: str
    driver: str
    where: str
    stage: Stage
    entry: EntryKey | None
    drive: Array | None
    columns: Array | None
    source: Driver | None = None

    @property
    def label(self) -> str:
        return f"{self.driver} → {self.where}"


def generic_blocks(scene: Scene) -> list[Generic]:
    """Every block that the recorded columns allow."""
    drivers = Drivers.of(scene)
    return [*_driven(scene, drivers), *_of_force(scene, drivers), *_of_reading(scene, drivers)]


def _driven(scene: Scene, drivers: Drivers) -> Iterator[Generic]:
    model = scene.base.model
    n = model.chain.n_joints
    joints = [f"joint{k + 1}" for k in range(n)]

    def block(by: Driver, entry: str, place: str, where: str, stage: Stage) -> Generic:
        # Six components each: fewer functions do, since the components share their shape.
        some = by.functions if entry == "joint_motion" else by.functions[:, :, :FRAME_WAVES]
        drive = _all(scene, entry, place, some)
        return Generic(by.kind, by.name, where, stage, (entry, (place,)), drive, None, by)

    for by in drivers.smooth():
        under_load = by.kind.startswith(("torque", "load"))
        for k, joint in enumerate(joints):
            if by.joint is None or by.joint == k:
                stage: Stage = "compliance" if under_load else "transmission"
                yield block(by, "joint_motion", joint, joint, stage)
        if by.kind in ("angle", "time", "load", "temperature"):
            for k in range(n):
                link = f"link{k + 1}"
                yield block(
                    by, "link_frame", link, link, "compliance" if under_load else "geometry"
                )
        if by.kind in ("angle", "time", "load", "temperature", "approach"):
            yield block(by, "base_motion", "base", "base", "tracker")
        if by.kind in ("time", "temperature", "load"):
            for marker in model.cell.tool.markers:
                place = f"marker:{marker}"
                yield block(by, "marker_motion", place, place, "tool")
        if by.kind in ("angle", "time") and scene.load_point is not None:
            yield _of_load_point(scene, by)


def _of_load_point(scene: Scene, by: Driver) -> Generic:
    """The hook moves: few functions for each of its directions, under load only."""
    assert scene.load_point is not None
    few = by.functions[:, :, :FEW_WAVES]
    W = np.einsum("cmv,cvf->cmf", scene.places.one_hot, few) * HOOK_MOTION
    columns = np.einsum("cmd,cmf->cmdf", scene.load_point, W)
    packed = columns.reshape(*columns.shape[:2], -1)
    return Generic(f"{by.kind} → load", by.name, "load", "load", None, None, packed)


def _all(scene: Scene, entry: str, place: str, W: Array) -> Array:
    """Each of the functions W (C, v, f) moves each component of the entry: (C, v, d, d·f)."""
    span = scene.columns.places[entry, place]
    d = span.stop - span.start
    units = ("m", "m", "m", "rad", "rad", "rad") if d == 6 else ("m",) * 3 if d == 3 else ("rad",)
    size = [BASE_MOTION if entry == "base_motion" else MOTION[u] for u in units]
    drive = np.einsum("de,cvf->cvdef", np.diag(size), W)
    return drive.reshape(*W.shape[:2], d, -1)


def _of_force(scene: Scene, drivers: Drivers) -> Iterator[Generic]:
    """Force and moment at a link's end, each moving or turning it along any axis."""
    for k, (force, moment) in enumerate(drivers.wrenches()):
        C, v, _ = force.shape
        drive = np.zeros((C, v, 6, 18))
        for a in range(3):
            drive[:, :, a, 3 * a : 3 * a + 3] = MOTION["m"] * force
            drive[:, :, 3 + a, 9 + 3 * a : 12 + 3 * a] = MOTION["rad"] * moment
        link = f"link{k + 1}"
        # Beyond the last link there is only the tool and its markers.
        where = "tool" if k == scene.base.model.chain.n_joints - 1 else link
        yield Generic("force", f"force at {where}", where, "compliance", ("link_frame", (link,)),
                      drive, None)  # fmt: skip


def _of_reading(scene: Scene, drivers: Drivers) -> Iterator[Generic]:
    """What differs from marker to marker in one visit: a field in space, the angle of view."""
    table, size = scene.base.seen.table, scene.base.seen.size
    if table.position is None or size < 3:
        return
    offset = table.position - scene.base.model.cell.tracker.position
    field = monomials(_standard(offset), 2) * MOTION["m"]
    shift = np.zeros((len(table), size, 3))
    shift[:, :3] = np.eye(3)
    rows = np.einsum("nsd,nf->nsdf", shift, field).reshape(len(table), size, -1)
    yield Generic("field", "position in the workspace", "tracker", "tracker", None, None,
                  scene.pack(rows))  # fmt: skip
    view = drivers.view()
    for marker in scene.base.model.cell.tool.markers:
        place = f"marker:{marker}"
        E = scene.columns.entry(("marker_motion", (place,)))
        rows = np.einsum("nsd,nf->nsdf", E, monomials(view, 2) * MOTION["m"])
        yield Generic("view", f"angle of view of {marker}", place, "tool", None, None,
                      scene.pack(rows.reshape(len(table), size, -1)))  # fmt: skip


def _standard(values: Array) -> Array:
    spread = np.maximum(np.ptp(values, axis=0) / 2, 1e-9)
    return (values - (values.max(axis=0) + values.min(axis=0)) / 2) / spread
