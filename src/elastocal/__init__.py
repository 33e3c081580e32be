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
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from elastocal.cell import Cell, Robot, Tool, Tracker, Workspace, read_cell
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
    from elastocal.plugins import register_criterion, register_effect, register_noise_model
    from elastocal.verbs import compensate, design, diagnose, identify, simulate

__version__ = "0.1.0"


def loaded_on_demand(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Returns `__getattr__` and `__dir__` of a package whose names are loaded when they are used.

    `homes` gives the names that each module has (PEP 562).
    """
    home_of = {name: home for home, names in homes.items() for name in names}

    def load(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(home_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: sorted({*vars(sys.modules[package]), *home_of})


# Where each name lives; a test holds this against the imports above.
_HOMES = {
    "elastocal.cell": ("Cell", "Robot", "Tool", "Tracker", "Workspace", "read_cell"),
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
    "register_criterion",
    "register_effect",
    "register_noise_model",
    "simulate",
]


__getattr__, __dir__ = loaded_on_demand(__name__, _HOMES)
