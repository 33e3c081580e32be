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

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from elastocal.cell import Cell, Robot, Tool, Tracker
    from elastocal.cell.work_cell import read_cell
    from elastocal.cell.workspace_rules import Workspace
    from elastocal.compensation.compensate import Compensation
    from elastocal.design.plan import Plan
    from elastocal.diagnosis.result import Diagnosis
    from elastocal.errors import (
        ElastocalError,
        InputError,
        InsufficientDataError,
        UnknownNameError,
    )
    from elastocal.identification.knowledge import Knowledge
    from elastocal.identification.result import Calibration
    from elastocal.manipulator.calibrated import CalibratedArm, read_calibrated
    from elastocal.manipulator.effects.base import Effect
    from elastocal.manipulator.model import Model
    from elastocal.manipulator.parameter import Parameter
    from elastocal.measurements import Measurements
    from elastocal.verbs import compensate, design, diagnose, identify, simulate

__version__ = "0.1.0"

# Where each name lives; a test holds this against the imports above.
_HOMES = {
    "elastocal.cell": ("Cell", "Robot", "Tool", "Tracker"),
    "elastocal.cell_reader": ("read_cell",),
    "elastocal.cell_workspace": ("Workspace",),
    "elastocal.compensation.compensate": ("Compensation",),
    "elastocal.design.plan": ("Plan",),
    "elastocal.diagnosis.result": ("Diagnosis",),
    "elastocal.errors": (
        "ElastocalError",
        "InputError",
        "InsufficientDataError",
        "UnknownNameError",
    ),
    "elastocal.identification.knowledge": ("Knowledge",),
    "elastocal.identification.result": ("Calibration",),
    "elastocal.manipulator.calibrated": ("CalibratedArm", "read_calibrated"),
    "elastocal.manipulator.effects.base": ("Effect",),
    "elastocal.manipulator.model": ("Model",),
    "elastocal.manipulator.parameter": ("Parameter",),
    "elastocal.measurements": ("Measurements",),
    "elastocal.plugins": ("register_criterion", "register_effect", "register_noise_model"),
    "elastocal.verbs": ("compensate", "design", "diagnose", "identify", "simulate"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "CalibratedArm",
    "Calibration",
    "Cell",
    "Compensation",
    "Diagnosis",
    "Effect",
    "ElastocalError",
    "InputError",
    "InsufficientDataError",
    "Knowledge",
    "Measurements",
    "Model",
    "Parameter",
    "Plan",
    "Robot",
    "Tool",
    "Tracker",
    "UnknownNameError",
    "Workspace",
    "compensate",
    "design",
    "diagnose",
    "identify",
    "read_calibrated",
    "read_cell",
    "simulate",
]


def __getattr__(name: str) -> Any:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'elastocal' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(home), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Front(ModuleType):
    """Keeps `design` the verb: importing the package elastocal.design would take its name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name == "design" and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Front
