"""What the user asks of a plan (DESIGN: [design])."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TargetPose:
    """A test pose, where position must be right: joints `q` (n,) rad or m and force (3,) N.

    `point` (3,) m in the flange frame; None: the markers themselves where their places are fitted,
    else the load point if the cell states one, else the mean over the markers.  `force` None: each
    of the design's loads that is not zero.  `degrees`: q was stated in degrees, which fits
    revolute joints only.
    """

    q: Array
    force: Array | None = None
    weight: float = 1.0
    point: Array | None = None
    degrees: bool = False


@dataclass(frozen=True)
class TargetPath:
    """A table of poses: q1_deg … (force_x_N …), or x_mm, y_mm, z_mm (rx_deg …) of the point."""

    file: Path
    force: Array | None = None
    point: Array | None = None


@dataclass(frozen=True)
class TargetBox:
    """`count` test poses with the point inside a box (m, data's frame), sampled.

    `rotation` (3, 3) of the flange in the data's frame, None for any that the arm reaches.
    """

    lower: Array
    upper: Array
    count: int = 20
    rotation: Array | None = None
    force: Array | None = None
    point: Array | None = None


@dataclass(frozen=True)
class Motion:
    """How the arm moves between poses: joint `speed` (n,) rad/s or m/s, (1,) where all are alike
    (None: equal speeds), `home` (n,), `dwell` s of
    measuring per pose, `load_change` s for hanging or taking off the load by hand,
    `both_directions`: approach every pose from both sides (`overshoot` rad), to show backlash.
    `degrees`: speed or home were stated in degrees, which fits revolute joints only."""

    speed: Array | None = None
    home: Array | None = None
    dwell: float = 30.0
    load_change: float = 600.0
    both_directions: bool = False
    overshoot: float = 0.05
    degrees: bool = False


@dataclass(frozen=True)
class DesignSpec:
    """`criterion`: the name of one that planning has.

    `levels` joint → values and `per_level` their numbers of poses (for at most one joint);
    `loads` (L, 3) N: forces under which poses are measured, all of them at every pose, or one of
    them chosen per pose where `load_choice`; `repeats` readings each.  `repeatability` m: standard
    deviation of a deviation common to a configuration's readings, per direction; `marker_sigma`
    m per marker instead of the tracker's noise; `interest`: parameters, places or effects that
    D, A, E and O count (default all but base and markers); `combination` name → factor for c."""

    poses: int | None = None
    criterion: str = "test_pose"
    levels: dict[str, tuple[float, ...]] = field(default_factory=dict)
    per_level: tuple[int, ...] = ()
    repeats: int = 1
    loads: Array | None = None
    load_choice: bool = False
    repeatability: float = 0.0
    marker_sigma: dict[str, float] = field(default_factory=dict)
    interest: tuple[str, ...] = ()
    combination: dict[str, float] = field(default_factory=dict)
    prior: Literal["none", "typical"] = "none"
    robust: Literal["none", "average", "worst"] = "none"
    robust_samples: int = 8
    candidates: int = 20_000
    target: float | None = None
    test_poses: tuple[TargetPose, ...] = ()
    test_path: TargetPath | None = None
    test_box: TargetBox | None = None
    motion: Motion = field(default_factory=Motion)
