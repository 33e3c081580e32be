"""The cell: what the user has (robot, tool, tracker, model, workspace) and asks of a plan.

A cell is read from a TOML file, `Cell.read("cell.toml")`, or built in Python from the same classes
in SI units.  Either way it is checked once and then frozen.
"""

from elastocal import loaded_on_demand

ROOMS = {
    "arm_description": (
        "CartesianNoise CompensatorTable EffectChoice ModelSpec Nominal Observe PolarNoise "
        "Robot Tool Tracker Unsteadiness"
    ),
    "file_keys": "table_of",
    "plan_wishes": "DesignSpec Freedom Motion TargetBox TargetPath TargetPose",
    "work_cell": "Cell read_cell",
    "workspace_rules": "CarriedBody HalfSpace HangingLoad Shape Solid Visibility Workspace",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
