"""The work cell around the arm: bodies, obstacles, keep-out, sight, load (DESIGN: [workspace]).

Positions of obstacles and half-spaces are in the data's frame (the tracker's, z vertical), those
of carried bodies in the frame of what carries them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shape = Literal["box", "sphere", "cylinder", "capsule", "mesh"]


@dataclass(frozen=True)
class Solid:
    """A rigid shape at `placement` (4, 4) in its carrier's frame.

    `size` in m: box (3,) edge lengths; sphere (1,) radius; cylinder (2,) radius and length along
    z; capsule (2,) radius and length between the centres of its caps along z; mesh (3,) scale of
    the file `mesh`.
    """

    name: str
    shape: Shape
    size: Array
    placement: Array = field(default_factory=lambda: np.eye(4))
    mesh: Path | None = None


@dataclass(frozen=True)
class CarriedBody:
    """A solid fixed to `on`: "base", "link1" … "linkN" (moved by joint N) or "flange"."""

    solid: Solid
    on: str = "flange"


@dataclass(frozen=True)
class HalfSpace:
    """Nothing may be where normal · (x − point) < 0; `normal` (3,) is a unit vector."""

    name: str
    point: Array
    normal: Array


@dataclass(frozen=True)
class HangingLoad:
    """What hangs at the load point by a rope, straight down, in loaded readings only.

    `solid` is upright, the rope's lower end at its top; `rope` its length in m.  `rope_axis` (3,)
    in the flange frame: the direction in which the rope leaves the tool; it may deviate from the
    vertical by `max_angle` rad.  `min_height` in m: lowest point of the load in the data's frame.
    """

    solid: Solid
    rope: float = 0.0
    rope_radius: float = 0.01
    rope_axis: Array | None = None
    max_angle: float | None = None
    min_height: float | None = None


@dataclass(frozen=True)
class Visibility:
    """What the tracker must see: all markers, past arm and obstacles.

    `normals` name → (3,) axis of the reflector in the flange frame, `max_incidence` rad from it;
    `range` m; `beam_radius` m of free sight.
    """

    normals: dict[str, Array] = field(default_factory=dict)
    max_incidence: float | None = None
    range: tuple[float, float] = (0.0, np.inf)
    beam_radius: float = 0.005
    line_of_sight: bool = True


@dataclass(frozen=True)
class Workspace:
    """`link_radius` (n,) m: capsules along the links, (1,) where all are alike, () for none;
    `urdf_geometry`: the URDF's own collision shapes.  `clearance` m to obstacles,
    `self_clearance` m between bodies of the arm; `ignored_pairs` of body names that may touch;
    `torque_limits` (n,) N m static, () none."""

    obstacles: tuple[Solid, ...] = ()
    bodies: tuple[CarriedBody, ...] = ()
    keep_out: tuple[HalfSpace, ...] = ()
    load: HangingLoad | None = None
    visibility: Visibility | None = None
    link_radius: tuple[float, ...] = ()
    urdf_geometry: bool = False
    self_collision: bool = True
    ignored_pairs: tuple[tuple[str, str], ...] = ()
    clearance: float = 0.0
    self_clearance: float = 0.0
    torque_limits: tuple[float, ...] = ()
