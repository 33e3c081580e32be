"""elastocal: calibrate industrial robot arms and explain what is left over.

    import elastocal as ec

    model = ec.Model("cell.toml")
    plan = ec.design(model, poses=15, criterion="test_pose")
    data = model.read("data.csv")
    fit = ec.identify(model, data)
    why = ec.diagnose(model, data)
    ec.compensate(fit.arm, targets, load=[0, 0, -2600])

Every name is loaded when it is first used, so that `import elastocal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from elastocal.cell import Cell, Workspace, read_cell
    from elastocal.cell_tables import Robot, Tool, Tracker
    from elastocal.compensation import Compensation
    from elastocal.diagnosis.changes import Comparison, compare
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.diagnosis.next_poses import next_poses
    from elastocal.identification.knowledge import Knowledge
    from elastocal.identification.result import Calibration
    from elastocal.importing.first_cell import init
    from elastocal.measurements import Measurements, table
    from elastocal.messages import (
        ElastocalError,
        InputError,
        InsufficientDataError,
        UnknownNameError,
    )
    from elastocal.model.calibrated import CalibratedArm, read_calibrated
    from elastocal.model.effects.base import Effect, Parameter
    from elastocal.model.manipulator import Model
    from elastocal.planning.plan import Plan
    from elastocal.plugins import register_criterion, register_effect, register_noise_model
    from elastocal.saving import load
    from elastocal.verbs import compensate, design, diagnose, effects, identify, simulate

__version__ = "0.1.0"

# Where each name lives; a test holds this against the imports above.
ROOMS = {
    "cell": "Cell Workspace read_cell",
    "cell_tables": "Robot Tool Tracker",
    "compensation": "Compensation",
    "diagnosis.changes": "Comparison compare",
    "diagnosis.diagnosis": "Diagnosis",
    "diagnosis.next_poses": "next_poses",
    "identification.knowledge": "Knowledge",
    "identification.result": "Calibration",
    "importing.first_cell": "init",
    "measurements": "Measurements table",
    "messages": "ElastocalError InputError InsufficientDataError UnknownNameError",
    "model.calibrated": "CalibratedArm read_calibrated",
    "model.effects.base": "Effect Parameter",
    "model.manipulator": "Model",
    "planning.plan": "Plan",
    "plugins": "register_criterion register_effect register_noise_model",
    "saving": "load",
    "verbs": "compensate design diagnose effects identify simulate",
}

__all__ = [
    "CalibratedArm", "Calibration", "Cell", "Comparison", "Compensation", "Diagnosis", "Effect",
    "ElastocalError", "InputError", "InsufficientDataError", "Knowledge", "Measurements",
    "Model", "Parameter", "Plan", "Robot", "Tool", "Tracker", "UnknownNameError", "Workspace",
    "compare", "compensate", "design", "diagnose", "effects", "identify", "init", "load",
    "next_poses", "read_calibrated", "read_cell", "register_criterion", "register_effect",
    "register_noise_model", "simulate", "table",
]  # fmt: skip

_HOME = {name: room for room, names in ROOMS.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """The public name, loaded when it is first used (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*_HOME, "__doc__", "__name__"})
