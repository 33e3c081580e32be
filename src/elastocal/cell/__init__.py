"""The cell: what the user has (robot, tool, tracker, model, workspace) and asks of a plan.

A cell is read from a TOML file, `Cell.read("cell.toml")`, or built in Python from the same classes
in SI units.  Either way it is checked once and then frozen.
"""

from elastocal.cell.arm_description import (
    CartesianNoise,
    CompensatorTable,
    EffectChoice,
    ModelSpec,
    Nominal,
    Observe,
    PolarNoise,
    Robot,
    Tool,
    Tracker,
)
from elastocal.cell.file_keys import rotation_from_rpy, table_of
from elastocal.cell.plan_wishes import DesignSpec, Motion, TargetBox, TargetPath, TargetPose
from elastocal.cell.work_cell import Cell, read_cell
from elastocal.cell.workspace_rules import (
    CarriedBody,
    HalfSpace,
    HangingLoad,
    Shape,
    Solid,
    Visibility,
    Workspace,
)
from elastocal.units import Array

__all__ = [
    "Array", "CarriedBody", "CartesianNoise", "Cell", "CompensatorTable", 
    "DesignSpec", "EffectChoice", "HalfSpace", "HangingLoad", "ModelSpec", "Motion", "Nominal",
    "Observe", "PolarNoise", "Robot", "Shape", "Solid", "TargetBox", "TargetPath", "TargetPose",
    "Tool", "Tracker", "Visibility", "Workspace", "read_cell",
    "rotation_from_rpy", "table_of",
]  # fmt: skip
