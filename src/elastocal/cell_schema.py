"""The keys of the cell file: names, types and what each takes (DESIGN: cell file)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector2 = Annotated[list[float], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive3 = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Numbers = Annotated[list[float], Field(min_length=1)]
JointName = Annotated[str, Field(pattern=r"^joint[1-9][0-9]{0,2}$")]


def _key(takes: str) -> Any:
    """An optional key; `takes` completes the sentence 'key … takes …' in messages."""
    return Field(default=None, description=takes)


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class RobotTable(Table):
    urdf: Text | None = _key('the path of a URDF file, e.g. "arm.urdf"')
    base: Text | None = _key("the name of a link of the URDF")
    flange: Text | None = _key("the name of a link of the URDF")
    dh: Text | None = _key('the path of a DH table, e.g. "nominal_dh.csv"')
    dh_convention: Literal["standard", "modified"] | None = _key('"standard" or "modified"')
    masses: Text | None = _key('the path of a table of link masses, e.g. "links.csv"')


class ToolTable(Table):
    load_point_m: Vector3 | None = _key("three numbers in m, in the flange frame")
    markers_m: dict[str, Vector3] | None = _key("three numbers in m per marker, flange frame")


class TrackerTable(Table):
    position_m: Vector3 | None = _key("three numbers in m")
    anchor_m: Vector3 | None = _key("three numbers in m")
    sigma_um: Positive | Positive3 | None = _key("one positive number in µm, or three for x, y, z")
    range_um: Positive | None = _key("a positive number in µm")
    range_ppm: NonNegative | None = _key("a number >= 0 in µm per m")
    transverse_um: Positive | None = _key("a positive number in µm")
    transverse_ppm: NonNegative | None = _key("a number >= 0 in µm per m")
    rotation_urad: Positive | None = _key("a positive number in µrad")
    distance_um: Positive | None = _key("a positive number in µm")


class CompensatorTable(Table):
    joint: JointName = Field(description='the joint the spring spans, e.g. "joint2"')
    stiffness_N_per_m: NonNegative | None = _key("a number >= 0 in N/m")
    anchor_m: Vector2 | None = _key("two numbers in m")
    arm_m: Positive | None = _key("a positive number in m")
    free_length_m: NonNegative | None = _key("a number >= 0 in m")


class NominalTable(Table):
    joint_compliance: Annotated[list[NonNegative], Field(min_length=1)] | None = _key(
        "one number >= 0 per joint, in rad/(N m)"
    )
    base_position_m: Vector3 | None = _key("three numbers in m")
    base_rpy_deg: Vector3 | None = _key("three numbers in degrees: roll, pitch, yaw")
    gravity_compensator: CompensatorTable | None = _key('a table with joint = "joint2"')


class ModelTable(Table):
    observe: Literal["position", "deflection", "pose", "distance"] | None = _key(
        '"position", "deflection", "pose" or "distance"'
    )
    effects: list[Text] | None = _key('a list of "effect" or "effect:where"')
    torque: Literal["computed", "measured"] | None = _key('"computed" or "measured"')
    link_gravity: bool | None = _key("true or false")
    deflection_model: Literal["equilibrium", "linear"] | None = _key('"equilibrium" or "linear"')
    compliance_levels: dict[str, Numbers] | None = _key(
        "a list of numbers per joint, as in joint2_deg = [-25.2, 0.0]"
    )
    gear_ripple_orders: list[Positive] | None = _key("a list of positive numbers")
    nominal: NominalTable | None = _key("a table")


class CellTable(Table):
    name: Text | None = _key("a text")
    robot: RobotTable = Field(description='a table with urdf = "arm.urdf" or dh = "dh.csv"')
    tool: ToolTable | None = _key("a table")
    tracker: TrackerTable | None = _key("a table")
    model: ModelTable | None = _key("a table")
    limits: dict[str, Vector2] | None = _key(
        "two numbers per joint, as in joint1_deg = [-170.0, 170.0]"
    )
    workspace: dict[str, Any] | None = _key("a table")
    design: dict[str, Any] | None = _key("a table")
