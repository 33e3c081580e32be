"""The keys of the cell file: names, types and what each takes (DESIGN: cell file)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from elastocal.cell_design_schema import DesignTable
from elastocal.cell_table import (
    NonNegative,
    Numbers,
    Positive,
    Positive3,
    Table,
    Text,
    Vector2,
    Vector3,
    key,
    required,
)
from elastocal.cell_workspace_schema import WorkspaceTable

JointName = Annotated[str, Field(pattern=r"^joint[1-9][0-9]{0,2}$")]


class RobotTable(Table):
    urdf: Text | None = key('the path of a URDF file, e.g. "arm.urdf"')
    base: Text | None = key("the name of a link of the URDF")
    flange: Text | None = key("the name of a link of the URDF")
    dh: Text | None = key('the path of a DH table, e.g. "nominal_dh.csv"')
    dh_convention: Literal["standard", "modified"] | None = key('"standard" or "modified"')
    masses: Text | None = key('the path of a table of link masses, e.g. "links.csv"')


class ToolTable(Table):
    load_point_m: Vector3 | None = key("three numbers in m, in the flange frame")
    markers_m: dict[str, Vector3] | None = key("three numbers in m per marker, flange frame")


class TrackerTable(Table):
    position_m: Vector3 | None = key("three numbers in m")
    anchor_m: Vector3 | None = key("three numbers in m")
    sigma_um: Positive | Positive3 | None = key("one positive number in µm, or three for x, y, z")
    range_um: Positive | None = key("a positive number in µm")
    range_ppm: NonNegative | None = key("a number >= 0 in µm per m")
    transverse_um: Positive | None = key("a positive number in µm")
    transverse_ppm: NonNegative | None = key("a number >= 0 in µm per m")
    rotation_urad: Positive | None = key("a positive number in µrad")
    distance_um: Positive | None = key("a positive number in µm")


class CompensatorTable(Table):
    joint: JointName = required('the joint the spring spans, e.g. "joint2"')
    stiffness_N_per_m: NonNegative | None = key("a number >= 0 in N/m")
    anchor_m: Vector2 | None = key("two numbers in m")
    arm_m: Positive | None = key("a positive number in m")
    free_length_m: NonNegative | None = key("a number >= 0 in m")


class NominalTable(Table):
    joint_compliance: Annotated[list[NonNegative], Field(min_length=1)] | None = key(
        "one number >= 0 per joint, in rad/(N m)"
    )
    base_position_m: Vector3 | None = key("three numbers in m")
    base_rpy_deg: Vector3 | None = key("three numbers in degrees: roll, pitch, yaw")
    gravity_compensator: CompensatorTable | None = key('a table with joint = "joint2"')
    settings: dict[str, dict[str, float]] | None = key(
        "a table per place, as in settings.joint2 = { jump_time_s = 720.0 }"
    )


class ModelTable(Table):
    observe: Literal["position", "deflection", "pose", "distance"] | None = key(
        '"position", "deflection", "pose" or "distance"'
    )
    effects: list[Text] | None = key('a list of "effect" or "effect:where"')
    torque: Literal["computed", "measured"] | None = key('"computed" or "measured"')
    link_gravity: bool | None = key("true or false")
    deflection_model: Literal["equilibrium", "linear"] | None = key('"equilibrium" or "linear"')
    compliance_levels: dict[str, Numbers] | None = key(
        "a list of numbers per joint, as in joint2_deg = [-25.2, 0.0]"
    )
    gear_ripple_orders: list[Positive] | None = key("a list of positive numbers")
    thermal_driver: Literal["time", "temperature"] | None = key('"time" or "temperature"')
    play_side: Literal["load", "load_and_approach"] | None = key('"load" or "load_and_approach"')
    nominal: NominalTable | None = key("a table")


class PluginsTable(Table):
    modules: list[Text] | None = key(
        'files and modules that register effects and the like, e.g. ["my_effects.py", "my_package"]'
    )


class CellTable(Table):
    name: Text | None = key("a text")
    robot: RobotTable = required('a table with urdf = "arm.urdf" or dh = "dh.csv"')
    tool: ToolTable | None = key("a table")
    tracker: TrackerTable | None = key("a table")
    model: ModelTable | None = key("a table")
    limits: dict[str, Vector2] | None = key(
        "two numbers per joint, as in joint1_deg = [-170.0, 170.0]"
    )
    workspace: WorkspaceTable | None = key("a table")
    design: DesignTable | None = key("a table")
    plugins: PluginsTable | None = key('a table with modules = ["my_effects.py"]')
