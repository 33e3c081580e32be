"""The arm in its poses with what is to be shown on it, in the data's frame, for the 3-D views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.design.feasibility.frames import Kinematics
from elastocal.manipulator.chain import Chain
from elastocal.report.arm_bodies import Shell, Shells, base_or_joint, shells_of
from elastocal.report.words import printable

if TYPE_CHECKING:
    from markupsafe import Markup

Array = NDArray[np.float64]

ARROW = 0.12  # length of a long arrow over the reach of what is drawn
LONG = 95.0  # percentile of the residuals that is drawn so long
AROUND = 0.35  # of the arm's reach: how far obstacles are shown beyond it
FAR = 1.2  # a tracker further off than this many extents would shrink the arm to a dot


@dataclass(frozen=True)
class Posed:
    """The arm in one pose.  `frames` (n + 1, 4, 4): base and joints after their motion; `markers`
    (m, 3) m with their `names`; `arrows` (m, 3) m, what is shown at each marker, or None."""

    name: str
    about: str
    frames: Array
    flange: Array
    markers: Array
    names: tuple[str, ...]
    arrows: Array | None = None

    @property
    def line(self) -> Array:
        """Base, joints and flange (n + 2, 3)."""
        return np.vstack([self.frames[:, :3, 3], self.flange[None, :3, 3]])


@dataclass(frozen=True)
class Space:
    """All poses, bodies, and the instrument where it stands near; `first` is shown first."""

    poses: tuple[Posed, ...]
    shells: Shells
    tracker: Array | None
    first: int
    what: str

    @property
    def has_arrows(self) -> bool:
        return any(p.arrows is not None for p in self.poses)

    @property
    def bodies(self) -> list[Array]:
        """Points (k, 3) m of the arm's bodies in the first pose."""
        frames = self.poses[self.first].frames
        placed = [(s.points, frames[base_or_joint(s)]) for s in self.shells.arm]
        return [points @ T[:3, :3].T + T[:3, 3] for points, T in placed]

    @property
    def extent(self) -> Array:
        """Corners (2, 3) of the box around everything that is drawn, with room for arrows."""
        every = np.vstack([points for p in self.poses for points in (p.line, p.markers)])
        every = np.vstack([every, *self.bodies])
        low, high = every.min(axis=0), every.max(axis=0)
        room = AROUND * float((high - low).max())
        # A hall's floor would shrink the arm to a dot.
        near = [np.clip(s.points, low - room, high + room) for s in self.shells.around]
        near += [] if self.tracker is None else [self.tracker[None]]
        every = np.vstack([every, *near])
        low, high = every.min(axis=0), every.max(axis=0)
        room = 0.07 * float((high - low).max()) + 1e-3
        return np.stack([low - room, high + room])

    @property
    def scale(self) -> float:
        """How many times as long as they are arrows are drawn: 1, 2 or 5 times a power of ten."""
        arrows = [p.arrows for p in self.poses if p.arrows is not None]
        size = np.linalg.norm(np.vstack(arrows), axis=1) if arrows else np.zeros(0)
        long = float(np.percentile(size, LONG)) if len(size) else 0.0
        if not long > 0:
            return 1.0
        wanted = ARROW * float(np.ptp(self.extent, axis=0).max()) / long
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(max(f * power for f in (1, 2, 5) if f * power <= wanted))


def frames_at(
    cell: Cell, chain: Chain, q: Array, flange: Array | None = None
) -> tuple[Array, Array]:
    """Frames (N, n + 1, 4, 4) of base and joints, and flanges (N, 4, 4), at joints q (N, n).

    The nominal chain, moved as a whole to end at `flange` (N, 4, 4) where that is known: on a
    page, the millimetres between the two cannot be seen.
    """
    kinematics = Kinematics(cell, chain)
    poses = kinematics.poses(q, np.zeros(3))
    base = np.broadcast_to(kinematics.T_data_base, (len(q), 1, 4, 4))
    frames = np.concatenate([base, poses.frames[:, : chain.n_joints]], axis=1)
    if flange is None:
        return frames, poses.flange
    T = np.where(np.isfinite(flange).all(axis=(1, 2), keepdims=True), flange, poses.flange)
    return (T @ np.linalg.inv(poses.flange))[:, None] @ frames, T


def space_of(
    cell: Cell, chain: Chain, poses: Sequence[Posed], first: int = 0, what: str = "pose"
) -> Space:
    """The poses with the bodies of the cell, and the tracker where it is known to stand near."""
    space = Space(tuple(poses), shells_of(cell, chain), None, first, what)
    low, high = space.extent
    at = cell.tracker.position
    if not at.any():
        return space  # the origin of its own data: most likely nobody said where it stands
    away = np.maximum(np.maximum(low - at, at - high), 0.0)
    near = float(np.linalg.norm(away)) < FAR * float((high - low).max())
    return Space(space.poses, space.shells, at if near else None, first, what)


def space_json(space: Space) -> Markup:
    """The space for the page's script: lengths in m, arrows in µm; safe within a script element."""
    low, high = space.extent
    content = {
        "what": space.what,
        "first": space.first,
        "scale": space.scale,
        "arrows": space.has_arrows,
        "range": np.stack([low, high], axis=1).round(3).tolist(),
        "tracker": None if space.tracker is None else space.tracker.round(3).tolist(),
        "bodies": [_shell(s, base_or_joint(s)) for s in space.shells.arm],
        "things": [_shell(s, 0) for s in space.shells.around],
        "poses": [_posed(p) for p in space.poses],
    }
    return in_script(content)


def in_script(content: object) -> Markup:
    """JSON in which nothing can end the element that holds it, whatever names hold."""
    from markupsafe import Markup

    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _shell(shell: Shell, carrier: int) -> dict[str, object]:
    points = shell.points.round(4).ravel().tolist()
    return {"carrier": carrier, "points": points, "faces": shell.faces.ravel().tolist()}


def _posed(p: Posed) -> dict[str, object]:
    return {
        "name": printable(p.name),
        "about": printable(p.about),
        "frames": p.frames[:, :3].round(5).reshape(len(p.frames), 12).tolist(),
        "line": p.line.round(4).tolist(),
        "markers": p.markers.round(4).tolist(),
        "names": [printable(name) for name in p.names],
        "arrows": None if p.arrows is None else (p.arrows * 1e6).round(2).tolist(),
    }
