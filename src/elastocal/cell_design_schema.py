"""The keys of [design]: what a plan is asked for, and what each key takes."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from elastocal.cell_table import (
    Count,
    NonNegative,
    Numbers,
    Positive,
    Positives,
    Table,
    Text,
    Vector3,
    key,
    required,
)

Counts = Annotated[list[Count], Field(min_length=1)]
Forces = Annotated[list[Vector3], Field(min_length=1)]
LOAD = "three numbers in N, a force in the data's frame"
POINT = "three numbers in m, a point in the flange frame"


class LevelsTable(Table):
    """One joint's levels under a key such as joint2_deg, and how many poses each gets."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Numbers] = Field(init=False)
    poses_per_level: Count | Counts | None = key("a whole number >= 1, or one per level")


class TargetPoseTable(Table):
    q_deg: Numbers | None = key("one number per joint, in degrees")
    q_si: Numbers | None = key("one number per joint, in rad or m")
    load_N: Vector3 | None = key(LOAD)
    weight: Positive | None = key("a positive number")
    point_m: Vector3 | None = key(POINT)


class TargetPathTable(Table):
    file: Text = required('the path of a table of poses, e.g. "path.csv"')
    load_N: Vector3 | None = key(LOAD)
    point_m: Vector3 | None = key(POINT)


class TargetBoxTable(Table):
    lower_m: Vector3 = required("three numbers in m, a corner in the data's frame")
    upper_m: Vector3 = required("three numbers in m, the opposite corner in the data's frame")
    count: Annotated[int, Field(ge=1, le=10_000)] | None = key("a whole number, 1 to 10000")
    rpy_deg: Vector3 | None = key("three numbers in degrees: roll, pitch, yaw of the flange")
    load_N: Vector3 | None = key(LOAD)
    point_m: Vector3 | None = key(POINT)


class MotionTable(Table):
    speed_deg_per_s: Positive | Positives | None = key("a positive number in °/s, or one per joint")
    speed_si: Positives | None = key("one positive number per joint, in rad/s or m/s")
    home_deg: Numbers | None = key("one number per joint, in degrees")
    home_si: Numbers | None = key("one number per joint, in rad or m")
    dwell_s: NonNegative | None = key("a number >= 0 in s")
    load_change_s: NonNegative | None = key("a number >= 0 in s")
    both_directions: bool | None = key("true or false")
    overshoot_deg: Positive | None = key("a positive number in degrees")


class DesignTable(Table):
    poses: Count | None = key("a whole number >= 1")
    criterion: Text | None = key('the name of a planning criterion, as "test_pose" or "D"')
    levels: LevelsTable | None = key("a list of numbers per joint, as in joint2_deg = [-25.2, 0.0]")
    repeats: Count | None = key("a whole number >= 1")
    loads_N: Forces | None = key("a list of forces in N, as in [[0, 0, 0], [0, 0, -2600]]")
    load_choice: bool | None = key("true or false")
    repeatability_um: NonNegative | None = key("a number >= 0 in µm")
    marker_sigma_um: dict[str, Positive] | None = key("a positive number in µm per marker")
    interest: list[Text] | None = key('a list of names, as in ["joint_compliance", "joint2"]')
    combination: dict[str, float] | None = key(
        'factors by parameter, with names in quotes, as in { "joint2.compliance" = 1.0 }'
    )
    prior: Literal["none", "typical"] | None = key('"none" or "typical"')
    robust: Literal["none", "average", "worst"] | None = key('"none", "average" or "worst"')
    robust_samples: Count | None = key("a whole number >= 1")
    candidates: Count | None = key("a whole number >= 1")
    target_um: Positive | None = key("a positive number in µm")
    test_pose: list[TargetPoseTable] | None = key("tables, each headed [[design.test_pose]]")
    test_path: TargetPathTable | None = key("a table headed [design.test_path]")
    test_box: TargetBoxTable | None = key("a table headed [design.test_box]")
    motion: MotionTable | None = key("a table headed [design.motion]")
