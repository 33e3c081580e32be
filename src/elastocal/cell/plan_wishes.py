"""What the user asks of a plan (DESIGN: [design])."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from elastocal.config import (
    AS_PATH,
    Count,
    File,
    Key,
    Many,
    NonNegative,
    Numbers,
    Positive,
    Rotation,
    Spot,
    Table,
    Text,
    Vector3,
    existing_file,
    fields_of,
    file_key,
    joint_values,
    key,
    keyed,
    numbers,
    record,
    stated,
    turn_key,
)
from elastocal.messages import require, wish
from elastocal.units import Array

Positives = Annotated[Array, numbers(above=0)]
TEST_POSE = "test_pose"  # the criterion where none is asked for
EXTRA_TIME = 0.05  # of the shortest time, for a longer way where none is stated
ELSEWHERE_CAP = 0.05  # where the user states no test poses: a price that buys most of what can be


SPEED_KEYS = (
    Key(
        "speed_deg_per_s",
        "a positive number in °/s, or one per joint",
        Annotated[Array, numbers(above=0, one_for_all=True)],
    ),
    Key("speed_si", "one positive number per joint, in rad/s or m/s", Positives),
)


FORCE = partial(keyed, "three numbers in N, a force in the data's frame", "load_N", default=None)
POINT = partial(keyed, "three numbers in m, a point in the flange frame", "point_m", default=None)


@record
class TargetPose:
    """A test pose, where position must be right: joints `q` (n,) rad or m and force (3,) N.

    `point` (3,) m in the flange frame; None: the markers themselves where their places are fitted,
    else the load point if the cell states one, else the mean over the markers.  `force` None: each
    of the design's loads that is not zero.  `degrees`: q was stated in degrees, which fits
    revolute joints only.
    """

    q: Numbers = keyed("one number per joint, in {}", "q_deg", "q_si")
    force: Vector3 | None = FORCE()
    weight: Positive = keyed("a positive number", default=1.0)
    point: Vector3 | None = POINT()
    degrees: bool = False

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """The joints, in one of two units."""
        spot.require(
            "q_deg" in table or "q_si" in table,
            f"key {spot.key('q_deg')} is missing; it takes one number per joint, in degrees "
            "(q_si: in rad or m)",
        )
        return {"degrees": "q_deg" in table}


@record
class TargetPath:
    """A table of poses: q1_deg … (force_x_N …), or x_mm, y_mm, z_mm (rx_deg …) of the point."""

    file: File = file_key('the path of a table of poses, e.g. "path.csv"', required=True)
    force: Vector3 | None = FORCE()
    point: Vector3 | None = POINT()


@record
class TargetBox:
    """`count` test poses with the point inside a box (m, data's frame), sampled.

    `rotation` (3, 3) of the flange in the data's frame, None for any that the arm reaches.
    """

    lower: Vector3 = keyed(
        "three numbers in m, a corner in the data's frame", "lower_m", required=True
    )
    upper: Vector3 = keyed(
        "three numbers in m, the opposite corner in the data's frame", "upper_m", required=True
    )
    count: Annotated[int, Field(ge=1, le=10_000)] = keyed("a whole number, 1 to 10000", default=20)
    rotation: Rotation | None = turn_key(
        "three numbers in degrees: roll, pitch, yaw of the flange", "rpy_deg", default=None
    )
    force: Vector3 | None = FORCE()
    point: Vector3 | None = POINT()

    def __post_init__(self) -> None:
        k = int(np.argmin(self.lower < self.upper))
        require(
            self.lower[k] < self.upper[k],
            f"{wish('test_box', '[design.test_box]')} takes lower_m < upper_m in x, y and z; "
            f"found {self.lower[k]:g} and {self.upper[k]:g} in {'xyz'[k]}; swap or correct them",
        )


@record
class Motion:
    """How the arm moves between poses: joint `speed` (n,) rad/s or m/s, (1,) where all are alike
    (None: equal speeds), `home` (n,), `dwell` s of a stop and `reading` s more for each reading of
    a marker in it, `load_change` s for hanging or taking off the load by hand, `both_directions`:
    approach every pose from both sides (`overshoot` rad), to show backlash. `load_changes`: how
    often at most the load may be hung, exchanged or taken off (None: as rarely as can be),
    `extra_time`: how much longer than by the shortest way all may take so that a drift does less
    (0: the shortest order; None: a little, and as much as pays for reading poses twice);
    `reference_every`: after so many visits one pose is visited again. `degrees`: speed or home were
    stated in degrees, which fits revolute joints only."""

    speed: Positives | None = keyed(keys=SPEED_KEYS, default=None)
    home: Numbers | None = keyed("one number per joint, in {}", "home_deg", "home_si", default=None)
    dwell: NonNegative = keyed("a number >= 0 in s", "dwell_s", default=30.0)
    reading: NonNegative = keyed("a number >= 0 in s", "reading_s", default=0.0)
    load_change: NonNegative = keyed("a number >= 0 in s", "load_change_s", default=600.0)
    both_directions: bool = keyed(default=False)
    overshoot: Positive = keyed("a positive number in degrees", "overshoot_deg", default=0.05)
    load_changes: Count | None = keyed("a whole number >= 1", default=None)
    extra_time: NonNegative | None = keyed("a number >= 0, a share of the time", default=None)
    reference_every: Count | None = keyed("a whole number >= 1", default=None)
    degrees: bool = False

    @property
    def longer(self) -> float:
        """The share of time by which the way may be longer than the shortest."""
        return EXTRA_TIME if self.extra_time is None else self.extra_time

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """Whether speed and home are in degrees; both must be, or none."""
        given = [stated(table, spot, fields_of(cls)[name]) for name in ("speed", "home")]
        names = [one[1] for one in given if one is not None]
        degrees = [not name.endswith("_si") for name in names]
        spot.require(
            all(degrees) or not any(degrees),
            f"keys {' and '.join(map(spot.key, names))} mix units; give both in degrees, or both "
            "in SI units (_si)",
        )
        return {"degrees": any(degrees)}


Box = Annotated[Array, numbers(2, 3)]
BOX = "two corners in m, as in [[0.1, -0.2, 0.1], [0.3, 0.2, 0.3]]"


@record
class Freedom:
    """What may still be chosen before measuring: boxes (2, 3) m, lower and upper corner, for
    `markers` by name and the `load_point` (flange frame) and for the `tracker` (data's frame), and
    how many of the design's `loads` that are not zero will hang."""

    markers: dict[str, Box] = keyed(
        f"per marker {BOX}", "markers_m", form=dict[str, Box], default_factory=dict
    )
    load_point: Box | None = keyed(BOX, "load_point_m", default=None)
    tracker: Box | None = keyed(BOX, "tracker_m", default=None)
    loads: Count | None = keyed("a whole number >= 1", default=None)

    def __post_init__(self) -> None:
        boxes = [(f"markers_m.{name}", box) for name, box in self.markers.items()]
        for name, box in (*boxes, ("load_point_m", self.load_point), ("tracker_m", self.tracker)):
            require(
                box is None or (box[0] <= box[1]).all(),
                f"[design.choose] {name} takes the lower corner and then the upper; "
                "swap or correct them",
            )


CANDIDATES = (
    'a whole number >= 1, a file of poses, as in "taught.csv", or both, as in ["taught.csv", 2000]'
)


def of_candidates(given: Any) -> tuple[int | None, str | Path | None] | None:
    """The number of poses to draw and the file of poses that are brought; None where it is neither,
    nor one of each."""
    parts = list(given) if isinstance(given, list | tuple) else [given]
    numbers = [p for p in parts if isinstance(p, int) and not isinstance(p, bool) and p > 0]
    files = [p for p in parts if isinstance(p, str | Path)]
    if len(numbers) > 1 or len(files) > 1 or len(numbers) + len(files) < len(parts) or not parts:
        return None
    return next(iter(numbers), None), next(iter(files), None)


class LevelsTable(Table):
    """One joint's levels under a key such as joint2_deg, and how many poses each gets."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Numbers] = Field(init=False)
    poses_per_level: Count | Annotated[list[Count], Field(min_length=1)] | None = key(
        "a whole number >= 1, or one per level"
    )


@record
class DesignSpec:
    """`criterion`: the name of one that planning has.

    `levels` joint → values and `per_level` their numbers of poses (for at most one joint); `loads`
    (L, 3) N: forces under which poses are measured, `load_states`: all of them at every pose, or
    chosen ones; `repeats` readings each.  `repeatability` m: standard deviation of a deviation
    common to the readings of a stop, per direction; `marker_sigma` m per marker instead of the
    tracker's noise; `interest`: parameters, places or effects that D, A, E and O count (default all
    but base and markers); `elsewhere`: the share of the weight that poses all over the joint ranges
    have beside the test poses; `elsewhere_cap`: by how much the test poses may be worse for as
    little error there as can be had (see `cap`); `combination` name → factor for c; `candidates` to
    draw, and `taught`: a table of poses that are brought, instead of these or beside them."""

    poses: Count | None = keyed("a whole number >= 1", default=None)
    criterion: Text = keyed(
        'the name of a planning criterion, as "test_pose" or "D"', default=TEST_POSE
    )
    levels: dict[str, Many[float]] = keyed(
        "a list of numbers per joint, as in joint2_deg = [-25.2, 0.0]",
        form=LevelsTable,
        default_factory=dict,
    )
    per_level: Many[Count] = ()
    repeats: Count = keyed("a whole number >= 1", default=1)
    loads: Annotated[Array, numbers(None, 3)] | None = keyed(
        "a list of forces in N, as in [[0, 0, 0], [0, 0, -2600]]", "loads_N", default=None
    )
    repeatability: NonNegative = keyed("a number >= 0 in µm", "repeatability_um", default=0.0)
    marker_sigma: dict[str, Positive] = keyed(
        "a positive number in µm per marker", "marker_sigma_um", default_factory=dict
    )
    interest: Many[Text] = keyed(
        'a list of names, as in ["joint_compliance", "joint2"]', default=()
    )
    combination: dict[str, float] = keyed(
        'factors by parameter, with names in quotes, as in { "joint2.compliance" = 1.0 }',
        default_factory=dict,
    )
    load_states: Literal["all", "chosen"] = keyed(default="all")
    prior: Literal["none", "typical"] = keyed(default="none")
    elsewhere: Annotated[float, Field(ge=0, lt=1)] | None = keyed(
        "a number from 0 to below 1", default=None
    )
    elsewhere_cap: NonNegative | None = keyed("a number >= 0, as in 0.05", default=None)
    candidates: Count | None = keyed(
        CANDIDATES,
        form=Count | Text | Annotated[list[Count | Text], Field(min_length=1, max_length=2)],
        default=None,
    )
    taught: Annotated[Path, AS_PATH] | None = None
    target: Positive | None = keyed("a positive number in µm", "target_um", default=None)
    minutes: Positive | None = keyed("a positive number", default=None)
    test_poses: Many[TargetPose] = keyed(
        "tables, each headed [[design.test_pose]]", "test_pose", default=()
    )
    test_path: TargetPath | None = keyed("a table headed [design.test_path]", default=None)
    test_box: TargetBox | None = keyed("a table headed [design.test_box]", default=None)
    motion: Motion = keyed("a table headed [design.motion]", default_factory=Motion)
    choose: Freedom | None = keyed("a table headed [design.choose]", default=None)

    def __post_init__(self) -> None:
        joints, levels = " and ".join(self.levels), wish("levels", "[design.levels]")
        require(
            len(self.levels) < 2,
            f"{levels} has levels of {joints}; only one joint can have levels: keep one, and "
            "narrow the others in [limits]",
        )
        for joint, values in self.levels.items():
            require(
                len(set(values)) == len(values),
                f"{levels} repeats a level of {joint}; give each once",
            )
        require(
            self.loads is None or len(np.unique(self.loads, axis=0)) == len(self.loads),
            f"{wish('loads', 'key design.loads_N')} repeats a load; give each once ([design] "
            "repeats says how often each is read)",
        )
        require(
            self.minutes is None or self.target is None,
            "keys design.minutes and design.target_um both ask for the number of poses; drop one",
        )
        require(
            not self.combination or any(self.combination.values()),
            f"{wish('combination', 'key design.combination')} has no factor other than zero; "
            "give the combination of parameters that is to be known well",
        )
        require(
            not (self.elsewhere and self.elsewhere_cap),
            f"{wish('elsewhere', 'keys design.elsewhere')} and "
            f"{wish('elsewhere_cap', 'design.elsewhere_cap')} both say what the joint ranges are "
            "worth beside the test poses; drop one",
        )

    @property
    def states_test_poses(self) -> bool:
        return bool(self.test_poses) or self.test_path is not None or self.test_box is not None

    @property
    def cap(self) -> float:
        """By how much ρ₀ may exceed the least, for as little error all over the joint ranges as
        can be had; 0 where `elsewhere` gives that a weight, or nobody asks for it."""
        if self.elsewhere_cap is not None or self.criterion != TEST_POSE:
            return self.elsewhere_cap or 0.0
        return 0.0 if self.elsewhere is not None or self.states_test_poses else ELSEWHERE_CAP

    @classmethod
    def from_keys(cls, table: Any, spot: Spot) -> dict[str, Any]:
        """The levels and their numbers of poses; where poses is not given, it is their sum."""
        given = table.get("levels") or LevelsTable()
        levels = joint_values(given.model_extra or {}, spot, "levels", ("poses_per_level",))
        per_level = _per_level(given.poses_per_level, levels, spot)
        poses = table.get("poses")
        if per_level:
            spot.require(
                poses in (None, sum(per_level)),
                f"key design.poses is {poses}, but the poses per level in [design.levels] sum to "
                f"{sum(per_level)}; drop or correct one of them",
            )
            poses = sum(per_level)
        for joint, values in levels.items():
            spot.require(
                poses is None or poses >= len(values),
                f"key design.poses is {poses}, but {joint} has {len(values)} levels in "
                "[design.levels], and each needs at least one pose; ask for more poses or fewer "
                "levels",
            )
        known = {"levels": levels, "per_level": per_level, "poses": poses}
        if "candidates" in table:
            found = of_candidates(table["candidates"]) or (None, None)
            told = f"takes {CANDIDATES}; found {table['candidates']}"
            spot.require(any(found), f"key {spot.key('candidates')} {told}")
            known["candidates"] = found[0]
            if found[1] is not None:
                known["taught"] = existing_file(str(found[1]), spot, "candidates")
        return known


def _per_level(
    given: int | list[int] | None, levels: dict[str, tuple[float, ...]], spot: Spot
) -> tuple[int, ...]:
    """The number of poses of each level of the one joint that has levels, () where not stated."""
    if given is None or len(levels) > 1:
        return ()
    spot.require(
        levels,
        "key design.levels.poses_per_level has no meaning without levels; name the joint, as in "
        "joint2_deg = [-90, -45, 0]",
    )
    ((joint, values),) = levels.items()
    if isinstance(given, int):
        return (given,) * len(values)
    spot.require(
        len(given) == len(values),
        f"key design.levels.poses_per_level has {len(given)} numbers for {len(values)} levels of "
        f"{joint}; give one number for all, or one per level",
    )
    return tuple(given)
